"""``dpdjax run``, ``scan``, ``merge`` and ``init``, of TOML files and what they make."""

import argparse
import os
import sys

from dpdjax.cli.arguments import STOPPED, of_programs

KINDS = ("fluid", "suspension", "marbles", "molecules", "scan")


def add(commands):
    """``run``, ``scan``, ``merge`` and ``init``."""
    run = commands.add_parser("run", help="run what a TOML file says")
    scan = commands.add_parser("scan", help="scan what a TOML file says")
    for parser, work, told in ((run, _run, "GSD file"), (scan, _scan, "netCDF file of the table")):
        parser.add_argument("config", metavar="FILE.toml", help="see dpdjax init")
        parser.add_argument("--out", metavar="FILE", help=f"{told} (default: what FILE.toml says)")
        hours = f"end after so many hours of wall time, with status {STOPPED}; the same command"
        parser.add_argument("--hours", type=float, default=None, help=f"{hours} goes on")
        parser.add_argument("--json", action="store_true", help="one JSON object at the end")
        of_programs(parser)
        parser.set_defaults(work=work, readable=_came_to, plot=None)
    resume = "go on with what is there; begin where nothing is"
    run.add_argument("--resume", action="store_true", help=resume)
    shard = "part i of n, from 1 on, into a table of its own: for arrays of jobs"
    scan.add_argument("--shard", metavar="i/n", type=_shard, default=None, help=shard)
    scan.add_argument(
        "--workers", metavar="n", type=int, default=None, help="processes of their own"
    )
    scan.add_argument("--retry", action="store_true", help="do again what failed")
    scan.add_argument("--csv", metavar="FILE.csv", default=None, help="write the points as text")
    scan.add_argument("--plot", metavar="FILE.png", default=None, help="draw the table into a file")
    merge = commands.add_parser("merge", help="the tables of the parts of a scan as one")
    merge.add_argument("parts", metavar="PART.nc", nargs="+")
    merge.add_argument("--out", metavar="FILE.nc", required=True)
    merge.set_defaults(work=_merge, readable=_came_to, plot=None, json=False, no_cache=True)
    init = commands.add_parser("init", help="write a TOML file to begin with, with comments")
    init.add_argument("kind", choices=KINDS)
    init.add_argument("file", metavar="FILE.toml", nargs="?", default=None)
    init.set_defaults(work=_init, readable=_came_to, plot=None, json=False, no_cache=True)


def _shard(text: str) -> tuple[int, int]:
    i, slash, n = text.partition("/")
    if not (slash and i.isdigit() and n.isdigit()):
        raise argparse.ArgumentTypeError(f"{text!r} is no part; give i/n, such as 1/3")
    return int(i), int(n)


def _run(arguments):
    from dpdjax.configs.running import run_file

    report = lambda text: print(text, file=sys.stderr, flush=True)
    result, is_complete = run_file(
        arguments.config,
        out=arguments.out,
        hours=arguments.hours,
        resume=arguments.resume,
        report=None if arguments.json else report,
        progress=not arguments.json,
    )
    return result | ({} if is_complete else {"stopped": True}), None


def _scan(arguments):
    from dpdjax.configs.running import scan_file
    from dpdjax.scans.table import scan_points

    result, is_complete = scan_file(
        arguments.config,
        out=arguments.out,
        hours=arguments.hours,
        shard=arguments.shard,
        workers=arguments.workers,
        retry=arguments.retry,
        progress=not arguments.json,
    )
    table = result.pop("table")
    points = scan_points(table)
    if arguments.csv:
        points.to_csv(arguments.csv, index=False)
    shown = points.to_dict("records") if arguments.json else f"\n{points.to_string(index=False)}"

    def figure():
        import dpdjax as dpd

        is_curve = "rate" in table.dims and "viscosity" in table
        return dpd.plot_flow_curve(table) if is_curve else dpd.plot_scan(table)

    stopped = {} if is_complete else {"stopped": True}
    return result | {"points": shown} | stopped, figure


def _merge(arguments):
    import dpdjax as dpd

    table = dpd.merge_scans(arguments.parts, arguments.out)
    done, runs = int((table.status == 1).sum()), int(table.status.size)
    left = {} if done == runs else {"left": f"{runs - done} runs, of parts not given or not ended"}
    return {"done": f"{done} of {runs} runs"} | left | {"file": arguments.out}, None


def _init(arguments):
    from importlib.resources import files

    target = arguments.file or f"{arguments.kind}.toml"
    if os.path.exists(target):
        raise FileExistsError(f"{target} is there already; give another name")
    example = files("dpdjax.configs") / "examples" / f"{arguments.kind}.toml"
    with open(target, "w", encoding="utf-8") as file:
        file.write(example.read_text(encoding="utf-8"))
    command = "scan" if arguments.kind == "scan" else "run"
    return {"wrote": target, "next": f"dpdjax {command} {target}"}, None


def _came_to(result) -> str:
    shown = lambda value: f"{value:.6g}" if isinstance(value, float) else str(value)
    return "\n".join(f"{name:15s} {shown(value)}" for name, value in result.items())
