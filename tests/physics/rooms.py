"""Rooms of measurements: each a function that returns rows of a table; results are kept as they
come."""

import datetime
import inspect
import json
import platform
import time
from pathlib import Path

import jax
import jax.numpy as jnp

import dpdjax as dpd
from dpdjax.measure.statistics import Estimate

HERE = Path(__file__).parent


def row(quantity, state, value, reference="", source="", note=""):
    """One line of the table; ``value`` and ``reference`` are estimates or numbers."""

    def plain(v):
        return [v.value, v.error] if isinstance(v, Estimate) else v

    return dict(
        quantity=quantity,
        state=state,
        value=plain(value),
        reference=plain(reference),
        source=source,
        note=note,
    )


def measure(rooms, names, data: str, page: str, heading: str):
    """Run the named rooms (all by default), and write the data (JSON) and the page (Markdown) after
    each.

    The first line of a room's docstring is its title; the rest says below its table what the
    numbers mean.
    """
    file = HERE / data
    for room in rooms:
        if names and room.__name__ not in names:
            continue
        began = time.monotonic()
        rows = room()
        results = (
            json.loads(file.read_text()) if file.exists() else {}
        )  # now: other rooms may run beside this one
        results[room.__name__] = {
            "title": title_and_text(room)[0],
            "date": datetime.date.today().isoformat(),
            "versions": f"dpdjax {dpd.__version__}, jax {jax.__version__}, Python "
            f"{platform.python_version()}",
            "device": jax.devices()[0].device_kind,
            "seconds": round(time.monotonic() - began),
            "rows": rows,
        }
        file.write_text(json.dumps(results, indent=1) + "\n")
        (HERE / page).write_text(table(rooms, results, heading))
        print(
            f"{room.__name__}: {results[room.__name__]['seconds']} s",
            *map(text, rows),
            sep="\n  ",
            flush=True,
        )


def stacked(states):
    """A batch of states whose lists have one capacity."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)


def title_and_text(room) -> tuple[str, str]:
    title, _, said = inspect.cleandoc(room.__doc__).partition("\n")
    return title, said.strip()


def text(r) -> str:
    return (
        f"{r['quantity']} | {r['state']} | {shown(r['value'])} | {shown(r['reference'])} | "
        f"{r['source']} | {r['note']}"
    )


def shown(value) -> str:
    if isinstance(value, list):
        return str(Estimate(*value))
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def table(rooms, results, heading: str) -> str:
    lines = [heading]
    for room in rooms:
        if room.__name__ not in results:
            continue
        r = results[room.__name__]
        lines += [
            "",
            f"## {r['title']}",
            "",
            f"{r['date']}, {r['versions']}, {r['device']}, {r['seconds']} s",
            "",
        ]
        lines += [
            "| quantity | state | value | reference | source | note |",
            "|---|---|---|---|---|---|",
        ]
        lines += [f"| {text(line)} |" for line in r["rows"]]
        said = title_and_text(room)[1]
        lines += ["", said] if said else []
    return "\n".join(lines) + "\n"
