"""``python -m dpdjax.cli``."""

import sys

from dpdjax.cli.main import main

sys.exit(main())
