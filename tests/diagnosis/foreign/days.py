"""Days of traffic without a fault: `python -m tests.diagnosis.foreign.days 24` looks whether anybody is blamed.

Each of the foreign systems runs under each kind of traffic for so many hours of the virtual clock, each in a process of
its own. A line is printed for each of them as it ends. The exit status is 1 if there was a false alarm.
"""

from __future__ import annotations

import argparse
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context

from tests.diagnosis.foreign.systems import SYSTEMS
from tests.diagnosis.foreign.trials import TRAFFICS, in_its_own_loop, trial


def healthy(name: str, kind: str, seed: int, hours: float, refusals: float) -> tuple[tuple[str, ...], float]:
    """Run a system under traffic for `hours` virtual hours; the false alarms, and the seconds of a core it took."""
    (foreign,) = (one for one in SYSTEMS if one.name == name)
    said = in_its_own_loop(trial(foreign, {}, kind, seed, hours * 3600.0, refusals))
    return said.false_alarms, time.process_time()


def main(arguments: list[str] | None = None) -> int:
    """Run the days that were asked for. Returns the exit status."""
    parser = argparse.ArgumentParser(description="hours of traffic without a fault, on the virtual clock")
    parser.add_argument("hours", type=float, help="virtual hours of each system under each kind of traffic")
    parser.add_argument("--only", default="", help="a part of the names to run, such as pipeline or bursty")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--refusals", type=float, default=0.0, help="the part of all asks that services refuse as usual"
    )
    parser.add_argument("--jobs", type=int, default=2, help="processes at a time")
    options = parser.parse_args(arguments)
    days = [(one.name, kind) for one in SYSTEMS for kind in TRAFFICS if options.only in f"{one.name} {kind}"]
    if not days:
        parser.error(f"no system and no traffic is called {options.only!r}")
    alarms = 0
    with ProcessPoolExecutor(options.jobs, get_context("spawn"), max_tasks_per_child=1) as pool:
        running = {pool.submit(healthy, *day, options.seed, options.hours, options.refusals): day for day in days}
        for done in as_completed(running):
            name, kind = running[done]
            said, seconds = done.result()
            alarms += len(said)
            print(
                f"{name}, {kind} traffic, seed {options.seed}: {options.hours:g} virtual hours, "
                f"{len(said)} false alarms ({seconds:.0f} s of a core)",
                *said[:5],
                sep="\n  ",
                flush=True,
            )
    return 1 if alarms else 0


if __name__ == "__main__":
    sys.exit(main())
