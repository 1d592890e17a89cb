"""Is one version of the library slower than another?

Runs the same benchmark files of two checkouts in turn (old new new old ...), each in a process of its own, and prints
for each job one JSON line:

    bench, job, unit       as the benchmark says them
    old, new               the medians of the values
    change                 the median over the pairs of new over old **in time** (rates are inverted): 1.02 is 2 %
                           slower
    low, high              the 95 % interval of that median
    pairs                  how many there were

Only the library's own values count; the limits beside them tell how quiet the machine was.

Command: python benchmarks/compare.py OLD NEW [--pairs 20] [--bench message --bench process] [--only TEXT] [--quick]
OLD and NEW are checkouts, each with a `.venv` of its own (`make .venv/.dev`).
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import subprocess
import sys
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from harness import TIMES


class Job(NamedTuple):
    """A line of a benchmark."""

    bench: str
    job: str
    unit: str


def measured(checkout: Path, bench: str, options: Sequence[str]) -> dict[Job, float]:
    """The values that one run of a benchmark file prints.

    Raises:
        SystemExit: it printed none, with what it said instead.
    """
    command = [str(checkout / ".venv/bin/python"), f"benchmarks/bench_{bench}.py", *options]
    done = subprocess.run(command, cwd=checkout, capture_output=True, text=True, check=False)
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    if not lines:
        sys.exit(f"{checkout}: {' '.join(command)} printed no figure:\n{done.stderr}")
    return {Job(line["bench"], line["job"], line["unit"]): line["value"] for line in lines}


def slower(job: Job, old: float, new: float) -> float:
    """By which factor the new value is worse."""
    return new / old if job.unit in TIMES else old / new


def interval(values: Sequence[float]) -> tuple[float, float]:
    """The 95 % interval of the median, from the order of the values alone (binomial; all of them if they are few)."""
    ordered, n = sorted(values), len(values)
    below, skip = 0.0, 0
    while skip < n // 2:
        below += math.comb(n, skip) / 2**n
        if below > 0.025:
            break
        skip += 1
    skip = max(0, skip - 1)
    return ordered[skip], ordered[n - 1 - skip]


def compare(old: Path, new: Path, bench: str, pairs: int, options: Sequence[str]) -> None:
    """Run one benchmark file `pairs` times in each checkout, and print its lines."""
    found: dict[Job, list[tuple[float, float]]] = defaultdict(list)
    for number in range(pairs):
        order = (old, new) if number % 2 == 0 else (new, old)
        values = {checkout: measured(checkout, bench, options) for checkout in order}
        for job in values[old].keys() & values[new].keys():
            before, after = values[old][job], values[new][job]
            if before > 0 and after > 0:
                found[job].append((before, after))
        print(f"{bench}: pair {number + 1} of {pairs}", file=sys.stderr)
    for job in sorted(found):
        ratios = [slower(job, *pair) for pair in found[job]]
        low, high = interval(ratios)
        figures = {
            "old": statistics.median(before for before, _ in found[job]),
            "new": statistics.median(after for _, after in found[job]),
            "change": statistics.median(ratios),
            "low": low,
            "high": high,
        }
        rounded = {name: float(f"{value:.4g}") for name, value in figures.items()}
        print(json.dumps({**job._asdict(), **rounded, "pairs": len(ratios)}), flush=True)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("--pairs", type=int, default=20)
    parser.add_argument("--bench", action="append", metavar="NAME", help="bench_NAME.py; may be given again (all)")
    parser.add_argument("--only", default="", metavar="TEXT", help="only jobs with TEXT in their function's name")
    parser.add_argument("--quick", action="store_true", help="a tenth of the messages")
    given = parser.parse_args()
    for checkout in (given.old, given.new):
        if not (checkout / ".venv/bin/python").exists():
            parser.error(f"{checkout} has no .venv/bin/python: run `make .venv/.dev` there")
    here = {path.stem.removeprefix("bench_") for path in (given.old / "benchmarks").glob("bench_*.py")}
    here &= {path.stem.removeprefix("bench_") for path in (given.new / "benchmarks").glob("bench_*.py")}
    if unknown := set(given.bench or ()) - here:
        parser.error(f"not in both checkouts: {', '.join(sorted(unknown))}; there are {', '.join(sorted(here))}")
    options = [*(["--only", given.only] if given.only else []), *["--quick"] * given.quick]
    for bench in given.bench or sorted(here):
        compare(given.old.resolve(), given.new.resolve(), bench, given.pairs, options)


if __name__ == "__main__":
    main()
