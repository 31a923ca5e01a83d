"""The command line: ``dpdjax design``, ``viscosity``, ``calibrate``, ``suspension``, ``bench``, and
``run``, ``scan``, ``merge`` and ``init`` of TOML files.

Nothing heavy is imported before the work starts."""

from dpdjax.cli.main import main as main
from dpdjax.cli.main import parser as parser
