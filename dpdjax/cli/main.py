"""The entry point, and the parser of all commands."""

import argparse
import importlib.metadata
import importlib.util
import json
import os
import sys

from dpdjax.cli import campaigns, design, solvent, suspension
from dpdjax.cli.arguments import FAILED, STOPPED

FORMATS = ("png", "pdf", "svg", "eps", "ps", "jpg", "jpeg", "tif", "tiff", "webp")
"""Endings of pictures."""


def main(argv=None) -> int:
    """Entry point; returns the exit status. Heavy imports wait until the work starts."""
    arguments = parser().parse_args(argv)
    try:
        _check_plot(arguments.plot)
        if not arguments.no_cache:
            _keep_programs()
        result, figure = arguments.work(arguments)
    except (ValueError, TypeError, RuntimeError, OSError, ImportError) as error:
        print(f"dpdjax {arguments.command}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"dpdjax {arguments.command}: interrupted", file=sys.stderr)
        return 130
    if arguments.json:
        print(json.dumps(result))
    else:
        print(arguments.readable(result))
    if result.get("stopped"):
        status = STOPPED
    else:
        status = FAILED if result.get("failed") else 0
    return _drawn(figure, arguments) or status if arguments.plot else status


def _drawn(figure, arguments) -> int:
    """Write the picture; the exit status where there is none to be drawn."""
    try:
        figure().figure.savefig(arguments.plot, dpi=150, bbox_inches="tight")
    except (ValueError, OSError) as error:
        print(f"dpdjax {arguments.command}: --plot {arguments.plot}: {error}", file=sys.stderr)
        return 2
    print(f"wrote {arguments.plot}", file=sys.stderr)
    return 0


def _keep_programs():
    """Keep compiled programs on disk; where there is no place for them, go on without."""
    from dpdjax.host.compilation import compilation_cache

    try:
        compilation_cache()
    except OSError as error:
        print(f"dpdjax: compiled programs are not kept: {error}", file=sys.stderr)


def _check_plot(path):
    """Raise ValueError before the work where its picture could not be written."""
    if path is None:
        return
    if importlib.util.find_spec("matplotlib") is None:
        raise ValueError('--plot needs matplotlib: pip install "dpdjax[plot]"')
    folder = os.path.dirname(path) or "."
    if not os.path.isdir(folder):
        raise ValueError(f"--plot {path}: there is no folder {folder}")
    if path.rpartition(".")[2] not in FORMATS:
        raise ValueError(f"--plot {path}: give a name in .png, .pdf or .svg")


def parser() -> argparse.ArgumentParser:
    """That of all commands."""
    found = argparse.ArgumentParser(
        prog="dpdjax",
        description="Dissipative particle dynamics: the viscosity of a friction, the friction of "
        "a viscosity.",
    )
    version = importlib.metadata.version("dpdjax")
    found.add_argument("--version", action="version", version=f"dpdjax {version}")
    commands = found.add_subparsers(dest="command", required=True)
    for room in (campaigns, design, solvent, suspension):
        room.add(commands)
    return found
