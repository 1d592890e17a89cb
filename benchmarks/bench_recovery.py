"""What does recovery bring back, at what cost, how soon? The tables of the RORY paper, ours beside theirs.

Baseline: the same program undisturbed, without recovery (Table II), and the time its `__init__` and its handlers take
in a new process without holdfast (Table IV).
An interval of 2 s of the recording between snapshots, as in the paper; the recording runs as fast as the program can.
Command: python benchmarks/bench_recovery.py [--quick]; HOLDFAST_PLOTS=FOLDER also draws the tables there as PNG.

Source: Zou and Bai, *Effective Crash Recovery of Robot Software Programs in ROS*, tables I to IV.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # Before numpy: sums are to be rounded alike here and in processes.

import dataclasses
import multiprocessing
import random
import resource
import statistics
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from harness import Run, main

import holdfast as hf
from holdfast.actors.values import decode_value, encode_value
from holdfast.checkpoint.home.recorded_home import switch_of
from holdfast.checkpoint.method import Method

PROGRAMS_FOLDER = Path(__file__).resolve().parents[1] / "examples/programs"
sys.path.append(str(PROGRAMS_FOLDER))

import common  # noqa: E402  (found by the line above)
from programs import PROGRAMS  # noqa: E402

INTERVAL = 2.0  # seconds of the recording between snapshots
KILL_AT = 9.0  # seconds of the recording, as in the paper
RANDOM_KILLS = 5
QUICK_LIMIT = 60  # messages
FIRST_STARTS = 5
FIRST_REPLAYS = 3
METHODS = ("fresh", "checkpoint_only", "replay_only", "hybrid")
MARKS = {True: "correct", False: "NOT", None: "some"}

PAPER_CORRECT = {  # Tables I and III: by program, for METHODS; None: in some runs
    "mapping": (False, False, True, True),
    "visual_map": (False, False, True, True),
    "visual_odometry": (False, False, True, True),
    "planning": (False, False, True, True),
    "particle_filter": (False, None, True, True),
    "scan_localisation": (False, None, True, True),
}
PAPER_COST = {  # Table II: CPU and memory, with over without
    "mapping": (1.6, 1.1),
    "visual_map": (1.2, 1.1),
    "visual_odometry": (1.2, 1.4),
    "planning": (1.2, 1.1),
    "particle_filter": (1.2, 1.1),
    "scan_localisation": (1.2, 1.3),
}
PAPER_TIMES = {  # Table IV, the real room: ms for checkpoint, replay, RORY
    "mapping": (2478, 9939, 4157),
    "visual_map": (9, 12991, 4397),
    "visual_odometry": (3, 9910, 3070),
    "planning": (1, 9155, 1478),
    "particle_filter": (8, 10162, 2235),
    "scan_localisation": (3, 9667, 2267),
}


@dataclasses.dataclass(frozen=True)
class Baseline:
    """A program undisturbed: what it ends with, and what it was told."""

    digest: str
    span: float  # seconds of the recording
    starting: float  # seconds that its own `__init__` takes in a new process, at most
    messages: tuple[hf.Message[Any], ...]
    times: tuple[float, ...]  # when each message was recorded
    played: float  # seconds that it took from the first message to the last: handlers, and what makes the messages

    @property
    def interval(self) -> float:
        """Seconds between snapshots that are two seconds of the recording at the speed at which it is played."""
        return max(0.02, INTERVAL * self.played / self.span)

    def number_at(self, moment: float) -> int:
        """The number of the message on its way at a moment of the recording; of a shorter one, in its last third."""
        moment = min(moment, self.span * 2 / 3)
        return next(number for number, when in enumerate(self.times, 1) if when >= moment)


def _limit(run: Run) -> int | None:
    return QUICK_LIMIT if run.quick else None


def _programs(run: Run) -> dict[str, type[common.Program]]:
    """The programs whose data are there; the others are named."""
    there = {}
    for name, kind in PROGRAMS.items():
        try:
            kind(common.DATA, _limit(run))
        except common.MissingData as error:
            print(f"# {name} is left out: {error}")
        else:
            there[name] = kind
    return there


def method_of(name: str, interval: float) -> Method:
    """A recovery method by the name it has in the tables."""
    match name:
        case "fresh":
            return hf.fresh()
        case "checkpoint_only":
            return hf.checkpoint_only(interval=interval)
        case "replay_only":
            return hf.replay_only()
        case _:
            return hf.hybrid(interval=interval)


async def baseline_of(kind: type[common.Program], limit: int | None) -> Baseline:
    """Run a program as a task: an ask adds a few microseconds to its handlers."""
    program = Timing(kind(common.DATA, limit))
    starting = first_start(program.start())
    result = await common.run(program, hf.fresh(), isolation="task")
    span, times = max(program.times[-1], 1e-3), tuple(program.times)
    return Baseline(result.digest, span, starting, tuple(program.messages), times, program.last - program.first)


def first_start(recipe: hf.Start[hf.Actor]) -> float:
    """Seconds that an actor's own `__init__` takes in a process that has done nothing yet, without holdfast around it.

    A recovery starts the program in a new process, where it takes longer than where it was started before: memory is
    touched for the first time and libraries set themselves up. How much longer varies: the `__init__` of
    `scan_localisation` takes 92 ms the second time and 98 to 208 ms the first time. That is the program's, not ours, so
    the longest of several is what a recovery is compared with.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context, max_tasks_per_child=1) as processes:
        return max(processes.submit(_seconds_of_init, recipe).result() for _ in range(FIRST_STARTS))


def _seconds_of_init(recipe: hf.Start[hf.Actor]) -> float:
    began = time.perf_counter()
    recipe.kind(*recipe.args, **recipe.kwargs)
    return time.perf_counter() - began


async def first_replays(recipe: hf.Start[hf.Actor], base: Baseline, spans: list[tuple[int, int]]) -> list[float]:
    """Seconds that the handlers of some messages take in a process that has done nothing yet, without holdfast in it.

    The actor is constructed, gets the state it had before the first of them, and handles them: what is replayed, and
    nothing else. In a process that has handled others before they take less: first calls into libraries set these up.

    Args:
        recipe: of the actor.
        base: its program undisturbed.
        spans: which messages, as first and end.
    """
    states: dict[int, bytes] = {}
    wanted = {first for first, _ in spans}
    async with hf.ActorSystem("baseline", log=False) as system:
        ref = await system.start(hf.child("program", recipe))
        for number in range(max(wanted) + 1):
            if number in wanted:
                states[number] = encode_value(await system.get_state(ref))
            await ref.ask(base.messages[number], timeout=common.PATIENCE)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context, max_tasks_per_child=1) as processes:
        return [
            statistics.median(
                processes.submit(_seconds_of_handlers, recipe, states[first], base.messages[first:end]).result()
                for _ in range(FIRST_REPLAYS)
            )
            for first, end in spans
        ]


def _seconds_of_handlers(recipe: hf.Start[Any], state: bytes, messages: tuple[hf.Message[Any], ...]) -> float:
    actor = recipe.kind(*recipe.args, **recipe.kwargs)
    variables: Any = decode_value(state)
    for name, value in variables.items():
        setattr(actor, name, value)
    began = time.perf_counter()
    for message in messages:
        actor._table[type(message)](actor, message)
    return time.perf_counter() - began


class Timing(common.Program):
    """A program that remembers its messages, when they were recorded, and how long they have taken altogether."""

    def __init__(self, program: common.Program) -> None:
        self._program = program
        self.messages: list[hf.Message[Any]] = []
        self.times: list[float] = []
        self.first = self.last = 0.0

    def start(self) -> hf.Start[hf.Actor]:
        return self._program.start()

    def feed(self) -> common.Feed:
        feed, reply = self._program.feed(), None
        self.first = time.perf_counter()
        while True:
            try:
                timed = feed.send(reply)
            except StopIteration:
                self.last = time.perf_counter()
                return
            self.messages.append(timed.message)
            self.times.append(timed.time)
            reply = yield timed

    def judge(self, state: dict[str, object]) -> common.Verdict:
        return self._program.judge(state)


async def _killed(kind: type[common.Program], limit: int | None, method: Method, number: int) -> common.Result:
    return await common.run(kind(common.DATA, limit), method, kill_at=(number,))


# -- Tables I, III and IV ---------------------------------------------------------------------------------------------


async def correctness_and_times(run: Run) -> None:
    """Each program, each method: killed at random moments, and at the paper's."""
    limit, table, times = _limit(run), {}, {}
    worst = 0.0
    for name, kind in _programs(run).items():
        base = await baseline_of(kind, limit)
        chance = random.Random(f"{run.seed} {name}")
        count = len(base.messages)
        numbers = [chance.randrange(count // 10 + 2, count) for _ in range(2 if run.quick else RANDOM_KILLS)]
        numbers.append(base.number_at(KILL_AT))
        for method in METHODS:
            results = [await _killed(kind, limit, method_of(method, base.interval), number) for number in numbers]
            right = sum(result.verdict.correct for result in results)
            same = sum(result.digest == base.digest for result in results)
            table[name, method] = (right, same, len(results))
            reports = [result.recoveries[0] for result in results if result.recoveries]
            if reports:
                at_nine = reports[-1]
                times[name, method] = {phase: seconds * 1e3 for phase, seconds in at_nine.phases.items()}
            if method == "hybrid":
                assert len(reports) == len(numbers), f"{name}: {len(reports)} recoveries of {len(numbers)}"
                recipe = kind(common.DATA, limit).start()
                spans = [(max(0, n - 1 - report.replayed), n - 1) for n, report in zip(numbers, reports, strict=True)]
                for handling, report in zip(await first_replays(recipe, base, spans), reports, strict=True):
                    over = sum(report.phases.values()) - base.starting - 1.1 * handling
                    worst = max(worst, over * 1e3)
    _print_correct(table)
    _print_times(times)
    _plot_correct(table)
    _plot_times(times)
    missed = sum(1 for (_, method), (_, same, runs) in table.items() if method == "hybrid" and same != runs)
    run.bound("programs with a hybrid run that does not end bit-identical", missed, unit="programs", target=0)
    job = "recovery beyond the program's own start and 1.1 times the handlers of what is replayed, worst run"
    run.bound(job, worst, unit="ms", target=20.0)


def _print_correct(table: dict[tuple[str, str], tuple[int, int, int]]) -> None:
    print("# Tables I and III: runs that end correct / bit-identical, of all; in brackets the paper")
    for name in dict.fromkeys(program for program, _ in table):
        cells = []
        for method, paper in zip(METHODS, PAPER_CORRECT[name], strict=True):
            right, same, runs = table[name, method]
            cells.append(f"{method} {right}/{same} of {runs} ({MARKS[paper]})")
        print(f"#   {name:18}", "  ".join(cells))


def _print_times(times: dict[tuple[str, str], dict[str, float]]) -> None:
    print(f"# Table IV: ms from the crash at {KILL_AT:g} s to the release; in brackets the paper, real room")
    for name in dict.fromkeys(program for program, _ in times):
        for method, paper in zip(METHODS[1:], PAPER_TIMES[name], strict=True):
            phases = times.get((name, method), {})
            parts = ", ".join(f"{phase} {spent:.1f}" for phase, spent in phases.items())
            print(f"#   {name:18} {method:16} {sum(phases.values()):7.1f} ({paper})   {parts}")


# -- Table II ---------------------------------------------------------------------------------------------------------


async def cost(run: Run) -> None:
    """CPU and memory with recovery over without: ten interleaved pairs for each program."""
    limit, rows = _limit(run), {}
    for name, kind in _programs(run).items():
        base = await baseline_of(kind, limit)
        ratios: list[tuple[float, float]] = []
        for _ in range(2 if run.quick else 10):
            without = await _used(kind, limit, hf.fresh(), None)
            with tempfile.TemporaryDirectory() as folder:
                store = f"sqlite:{folder}/robot.db"
                having = await _used(kind, limit, hf.hybrid(interval=base.interval, keep=2), store)
            ratios.append((having[0] / without[0], having[1] / without[1]))
        cpu, memory = (statistics.median(column) for column in zip(*ratios, strict=True))
        rows[name] = (cpu, memory)
    print("# Table II: with recovery over without; in brackets the paper")
    for name, (cpu, memory) in rows.items():
        print(f"#   {name:18} CPU {cpu:.2f}x ({PAPER_COST[name][0]}x)  memory {memory:.2f}x ({PAPER_COST[name][1]}x)")
    _plot_cost(rows)
    if rows:
        mean = [statistics.mean(column) for column in zip(*rows.values(), strict=True)]
        run.bound("CPU with recovery over without, mean of the programs", mean[0], unit="x", target=1.05)
        run.bound("memory with recovery over without, mean of the programs", mean[1], unit="x", target=1.10)


async def _used(
    kind: type[common.Program], limit: int | None, method: Method, store: str | None
) -> tuple[float, float]:
    """CPU seconds of all processes of a run (they are all over by then), and bytes at its end."""
    before = _cpu()
    result = await common.run(kind(common.DATA, limit), method, store=store)
    return _cpu() - before, float(result.memory)


def _cpu() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


# -- those who stand by -----------------------------------------------------------------------------------------------


class Ping(hf.Message[int]):
    """Asked of who stands by."""


class Work(hf.Message[int]):
    """Counted, with some work."""


class Bystander(hf.Actor):
    @hf.on(Ping)
    def answer(self, message: Ping) -> int:
        return 1


class Worker(hf.Actor):
    """Counts, and takes about half a millisecond for it."""

    def __init__(self) -> None:
        self.count = 0

    @hf.on(Work)
    def work(self, message: Work) -> int:
        end = time.perf_counter() + 0.0005
        while time.perf_counter() < end:
            pass
        self.count += 1
        return self.count


async def bystanders(run: Run) -> None:
    """Asks to another actor while one in a process recovers, beside the same when all is quiet."""
    messages = run.size(2_000)
    async with hf.ActorSystem("bench", log=False, intensity=1000) as system:
        recovery = hf.hybrid(interval=3600.0)
        worker = await system.start(hf.child("worker", hf.start(Worker), isolation="process", recovery=recovery))
        other = system.spawn(hf.start(Bystander), "other")
        for _ in range(messages):
            await worker.ask(Work())

        async def p99_while(busy: bool) -> float:
            waits: list[float] = []
            answer = None
            if busy:
                os.kill(system.pid_of(worker), 9)
                answer = worker.ask(Work(), timeout=60.0)
            end = time.perf_counter() + messages * 0.0005
            while time.perf_counter() < end if answer is None else not answer.done():
                began = time.perf_counter()
                await other.ask(Ping())
                waits.append(time.perf_counter() - began)
                await _pause()
            if answer is not None:
                await answer
            return statistics.quantiles(waits, n=100)[98] * 1e6

        await run.compare(
            "p99 of an ask to another actor while one recovers, beside quiet",
            lambda: p99_while(busy=True),
            lambda: p99_while(busy=False),
            unit="us",
            target=0.5,
        )


async def _pause() -> None:
    import asyncio

    await asyncio.sleep(0.0005)


async def memory_bound(run: Run) -> None:
    """A producer twice as fast as a recorded actor: what is held stays below the bound it was given."""
    capacity, sent = 1_000, run.size(20_000)
    async with hf.ActorSystem("bench", log=False) as system:
        recovery = hf.hybrid(interval=0.5)
        spec = hf.child("worker", hf.start(Worker), recovery=recovery, mailbox=hf.bounded(capacity))
        worker = await system.start(spec)
        switch = switch_of(worker._cell)
        assert switch is not None
        most = 0
        for _ in range(sent):
            await worker.send(Work())
            most = max(most, switch.ledger.backlog(-1))
        while await worker.ask(Work(), timeout=60.0) < sent:
            pass
    run.bound("messages held for a slow recorded actor, over its bound", most / capacity, unit="x", target=1.01)


# -- pictures ---------------------------------------------------------------------------------------------------------


def _figure(
    title: str, names: list[str], series: dict[str, list[float]], unit: str, file: str, *, log: bool = False
) -> None:
    """Groups of bars as a PNG in HOLDFAST_PLOTS; nothing without it."""
    folder = os.environ.get("HOLDFAST_PLOTS")
    if not folder:
        return
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.5), layout="constrained")
    axes = figure.subplots()
    width = 0.8 / len(series)
    for index, (label, values) in enumerate(series.items()):
        axes.bar([at + index * width for at in range(len(names))], values, width, label=label)
    axes.set_xticks([at + 0.4 - width / 2 for at in range(len(names))], names)
    axes.set_ylabel(unit)
    axes.set_title(title)
    if log:
        axes.set_yscale("log")
    axes.legend()
    Path(folder).mkdir(parents=True, exist_ok=True)
    figure.savefig(Path(folder) / file, dpi=120)


def _plot_correct(table: dict[tuple[str, str], tuple[int, int, int]]) -> None:
    names = list(dict.fromkeys(program for program, _ in table))
    right = {method: [table[name, method][0] / table[name, method][2] for name in names] for method in METHODS}
    same = {method: [table[name, method][1] / table[name, method][2] for name in names] for method in METHODS}
    _figure("Runs that end correct, by method", names, right, "share of runs", "table1_correct.png")
    _figure("Runs that end bit-identical, by method", names, same, "share of runs", "table3_identical.png")


def _plot_cost(rows: dict[str, tuple[float, float]]) -> None:
    series = {
        "CPU": [cpu for cpu, _ in rows.values()],
        "CPU, paper": [PAPER_COST[name][0] for name in rows],
        "memory": [memory for _, memory in rows.values()],
        "memory, paper": [PAPER_COST[name][1] for name in rows],
    }
    _figure("Cost of recovery", list(rows), series, "with over without", "table2_cost.png")


def _plot_times(times: dict[tuple[str, str], dict[str, float]]) -> None:
    names = list(dict.fromkeys(program for program, _ in times))
    series = {method: [sum(times.get((name, method), {}).values()) or 0.01 for name in names] for method in METHODS[1:]}
    for index, method in enumerate(METHODS[1:]):
        series[f"{method}, paper"] = [float(PAPER_TIMES[name][index]) for name in names]
    _figure("Recovery after a crash at 9 s", names, series, "ms", "table4_times.png", log=True)


if __name__ == "__main__":
    main([correctness_and_times, cost, bystanders, memory_bound])
