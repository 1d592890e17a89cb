"""The fault-injection campaign and the soak, as `bench_ftm.py` runs them.

`HOLDFAST_REQUESTS` is the number of requests for each row, `HOLDFAST_FAULTS` the most faults, `HOLDFAST_ROWS` patterns
of the rows to run ("PBR|crash*|counter;TMR|*"), `HOLDFAST_TABLE` a file to which each row is added: rows that are in it
are not run again.
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


async def campaign(run: Run) -> None:
    """Each fault at each step under each mechanism, as a table."""
    requests = int(os.environ.get("HOLDFAST_REQUESTS", "200" if run.quick else "2000"))
    most = int(os.environ.get("HOLDFAST_FAULTS", "4" if run.quick else "40"))
    file = Path(os.environ.get("HOLDFAST_TABLE", os.devnull))
    lines = file.read_text().splitlines() if file.is_file() else []
    done = [msgspec.json.decode(line, type=engine.Row) for line in lines]
    known = {(row.mechanism, row.kind, row.workload) for row in done}
    print(f"# {engine.HEAD}", flush=True)
    for name, kind, workload in rows():
        if (name, kind, workload) in known:
            continue
        layers: Any = stacks.STACKS[name](workload)
        row = await engine.run_row(name, layers, kind, workload, requests=requests, most=most, seed=str(run.seed))
        done.append(row)
        if file.parent.is_dir() and file != Path(os.devnull):
            with file.open("ab") as out:
                out.write(msgspec.json.encode(row) + b"\n")
        print(f"# {row}{' BROKEN' * (not row.is_kept)}", flush=True)
        for line in [*row.trouble[:6], *(f"not reached: {one}" for one in row.unreached[:3])]:
            print(f"#     {line}", flush=True)
    print("\n".join(f"# {line}" for line in engine.table(done).splitlines()))
    print(f"# {sum(row.injected for row in done)} faults, {sum(row.requests for row in done)} requests")
    missed = sum(not row.is_kept for row in done)
    run.bound("rows of the campaign in which a mechanism did not keep what it claims", missed, unit="rows", target=0)


async def soaking(run: Run) -> None:
    """Random attach, compose, transition, update, detach under full load, and random kills."""
    seconds = float(os.environ.get("HOLDFAST_SOAK", "5" if run.quick else "60"))
    found = await soak.run(seconds, random.Random(run.seed))
    print(f"# soak: {found}")
    run.bound("soak: lost, wrong or doubled", len(found.bad.all()) + bool(found.stuck), unit="requests", target=0)
