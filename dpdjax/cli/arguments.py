"""Arguments that several commands take, and what they mean."""

import sys
import time

STOPPED, FAILED = 75, 1
"""Exit status of a run that was ended before its plan, and can be gone on with; and of a scan some
runs of which failed."""
WAYS = ("velocity-verlet", "implicit-drag", "multiple-time-step")


def of_fluid(parser):
    """Numbers of the solvent."""
    of_numbers(parser, kT=1.0, suits="drag: right to 0.5 %%")
    parser.add_argument(
        "--repulsion", type=float, default=25.0, help="a of the soft repulsion (default: 25)"
    )


def of_numbers(parser, *, kT: float, suits: str):
    """Density, kT, step, seed; and ``--json``."""
    parser.add_argument(
        "--density", type=float, default=3.0, help="solvent beads per volume (default: 3)"
    )
    parser.add_argument("--kT", type=float, default=kT, help=f"thermal energy (default: {kT:g})")
    parser.add_argument(
        "--dt", type=float, default=None, help=f"time step (default: suits {suits})"
    )
    parser.add_argument("--seed", type=int, default=0, help="of all random numbers (default: 0)")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")


def of_motion(parser, default="what covers most time for its cost; with --dt velocity-verlet"):
    """The integrator."""
    parser.add_argument(
        "--integrator", choices=WAYS, default=None, help=f"how beads move on (default: {default})"
    )


def integrator(arguments):
    """The integrator that is named; None for that of the door."""
    import dpdjax as dpd

    name = arguments.integrator
    return name and getattr(dpd.integrators, name.title().replace("-", ""))()


def of_programs(parser):
    """Whether compiled programs are kept."""
    kept = "compile anew; by default compiled programs are kept in the user's folder for caches"
    parser.add_argument("--no-cache", action="store_true", help=kept)


def of_viscosity(parser):
    """Of what shears a solvent."""
    of_fluid(parser)
    of_programs(parser)
    of_motion(parser)
    parser.add_argument(
        "--rate",
        type=float,
        default=None,
        help="shear rate (default: bias below half the tolerance)",
    )
    parser.add_argument(
        "--box",
        type=float,
        default=None,
        help="side of each of the two boxes (default: 10; less, to 6, at tolerances above 0.05)",
    )
    parser.add_argument(
        "--tolerance",
        type=float,
        default=0.02,
        help="relative; the standard error is a third (default: 0.02)",
    )
    parser.add_argument(
        "--plot", metavar="FILE.png", default=None, help="draw the result into a file"
    )


def water(arguments, gamma):
    """The solvent."""
    import dpdjax as dpd

    return dpd.fluid(
        conservative=[dpd.term(dpd.soft_repulsion, a=arguments.repulsion, r_c=1.0)],
        drag=[dpd.term(dpd.central_drag, gamma=gamma, r_c=1.0)],
        kT=arguments.kT,
    )


def reporter():
    """Lines on standard error, with the time since now."""
    began = time.monotonic()
    return lambda text: print(
        f"[{time.monotonic() - began:5.0f} s] {text}", file=sys.stderr, flush=True
    )
