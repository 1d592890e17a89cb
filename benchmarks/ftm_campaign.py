"""The fault-injection campaign and the soak, as `bench_ftm.py` runs them.

As it is, a sample of the rows, by the seed. `HOLDFAST_REQUESTS=10000` has all of them run, with so many requests each;
`HOLDFAST_FAULTS` is the most faults of a row, `HOLDFAST_ROWS` patterns of rows ("PBR|crash*|counter;TMR|*"),
`HOLDFAST_TABLE` a file to which each row is added: rows that are in it are not run again.
"""

from __future__ import annotations

import fnmatch
import os
import random
from pathlib import Path
from typing import Any

import msgspec
from harness import Run

from tests.ftm import campaign as engine  # pyright: ignore[reportMissingImports]  # bench_ftm has put it on the path
from tests.ftm import faults, soak, stacks, workloads  # pyright: ignore[reportMissingImports]

EVERYWHERE = (
    "nothing",
    "crash of a replica",
    "crash of a brick",
    "SIGSTOP",
    "message doubled",
    "answer, transient",
    "state, transient",
)
"""Kinds that are tried with each workload, where they are claimed; the others with the counter."""
SAMPLE = 20  # rows, if nobody says how long


def rows() -> list[tuple[str, str, str]]:
    """Mechanism, kind of fault, workload: what makes sense."""
    pattern = os.environ.get("HOLDFAST_ROWS", "*")
    found = [
        (name, kind, workload)
        for workload in workloads.WORKLOADS
        for name, make in stacks.STACKS.items()
        for kind in faults.KINDS
        if faults.makes_sense(make(workload), kind, workload)
        if workload == "counter" or (kind in EVERYWHERE and faults.claims(make(workload), kind))
    ]
    return [row for row in found if any(fnmatch.fnmatch("|".join(row), one) for one in pattern.split(";"))]


def chosen(run: Run) -> list[tuple[str, str, str]]:
    """The rows to run: all, if it is said how long; else a few of those in which something is claimed."""
    if os.environ.keys() & {"HOLDFAST_REQUESTS", "HOLDFAST_ROWS"}:
        return rows()
    claimed = [row for row in rows() if faults.claims(stacks.STACKS[row[0]](row[2]), row[1])]
    return random.Random(run.seed).sample(claimed, run.size(SAMPLE))


async def campaign(run: Run) -> None:
    """Each fault at each step under each mechanism, as a table."""
    requests, most = int(os.environ.get("HOLDFAST_REQUESTS", "100")), int(os.environ.get("HOLDFAST_FAULTS", "40"))
    if "HOLDFAST_REQUESTS" not in os.environ:
        most = min(most, 4)
    kept = os.environ.get("HOLDFAST_TABLE", "")
    lines = Path(kept).read_text().splitlines() if kept and Path(kept).is_file() else []
    done = [msgspec.json.decode(line, type=engine.Row) for line in lines]
    known = {(row.mechanism, row.kind, row.workload) for row in done}
    print(f"# {engine.HEAD}", flush=True)
    for name, kind, workload in chosen(run):
        if (name, kind, workload) in known:
            continue
        layers: Any = stacks.STACKS[name](workload)
        row = await engine.run_row(name, layers, kind, workload, requests=requests, most=most, seed=str(run.seed))
        done.append(row)
        if kept:
            with Path(kept).open("ab") as file:
                file.write(msgspec.json.encode(row) + b"\n")
        print(f"# {row}{'' if row.is_kept else ' BROKEN'}", flush=True)
        for line in [*row.trouble[:6], *(f"not reached: {one}" for one in row.unreached[:3])]:
            print(f"#     {line}", flush=True)
    print("\n".join(f"# {line}" for line in engine.table(done).splitlines()))
    print(f"# {sum(row.injected for row in done)} faults, {sum(row.requests for row in done)} requests")
    missed = sum(not row.is_kept for row in done)
    run.bound("rows of the campaign in which a mechanism did not keep what it claims", missed, unit="rows", target=0)


async def soaking(run: Run) -> None:
    """Random attach, compose, transition, update, detach under full load, and random kills."""
    seconds = float(os.environ.get("HOLDFAST_SOAK", "5" if run.quick else "15"))
    found = await soak.run(seconds, random.Random(run.seed))
    print(f"# soak: {found}")
    run.bound("soak: lost, wrong or doubled", len(found.bad.all()) + bool(found.stuck), unit="requests", target=0)
