"""Schedules: every strategy finds what it should, a run is repeated exactly, and a failure is shrunk and shown."""

from __future__ import annotations

import asyncio
import concurrent.futures
import datetime
import itertools
import os
import random
import re
import socket
import subprocess
import sys
import threading
import time
import uuid
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy.random
import pytest

import holdfast as hf
from holdfast.testing import GuardedSystem, Simulation, idle, simulate
from holdfast.testing.schedules.choices import (
    BadSchedule,
    NotRepeatable,
    Production,
    Replay,
    Taken,
    Walk,
    as_text,
    from_text,
    size,
)
from holdfast.testing.schedules.shrinking import FailedRun, shrink
from holdfast.testing.schedules.strategies import NAMES, Priorities, mixed, strategy
from holdfast.testing.schedules.world import EPOCH, EscapesSimulation
from holdfast.testing.simulation import NotExhausted, ScheduleSearch, SimulationSettings, run_schedule
from tests.testing.schedules.planted import (
    PLANTED,
    Go,
    Note,
    Planted,
    Step,
    Teller,
    between_two_steps,
    one_gate_after_the_other,
    order_of,
    restart_order,
)

OWN = {"system"}
SHOWN_BY_PRODUCTION = {"late_reply", "recorded_non_determinism"}
MOST = {"exhaustive": 1500}


def runs_needed(planted: Planted, name: str, most: int = 600) -> int | None:
    """How many runs a strategy needs until the bug shows; None: more than `most`."""
    tried = strategy(name)
    for number in range(most):
        choices = tried.choices(number)
        if choices is None:
            return None
        try:
            run = run_schedule(planted, choices, OWN, {}, looks=False)
        except Exception:  # The bug, whatever it raises.
            return number + 1
        tried.learn(choices, run.trace)
    return None


def found(test: Any, **options: Any) -> BaseException:
    """What a simulated test fails with."""
    with pytest.raises((AssertionError, hf.HoldfastError)) as caught:
        simulate(test, **options)()
    return caught.value


@pytest.mark.parametrize("name", [name for name in PLANTED if name not in ("order_of_6",)])
def test_the_default_finds_a_planted_bug_and_shrinks_it(name: str) -> None:
    error = found(PLANTED[name])
    [note] = error.__notes__
    _, _, text = note.partition('replay="')
    seed, taken = from_text(text.partition('"')[0])
    if name not in SHOWN_BY_PRODUCTION:
        assert 1 <= size(taken) <= 12
    for _ in range(2):
        again = found(PLANTED[name], replay=as_text(seed, taken))
        assert type(again) is type(error)
    assert re.search(r"^the \d+ turns? ", note, re.M)


@pytest.mark.parametrize(
    "planted",
    [
        *(PLANTED[name] for name in PLANTED if name not in SHOWN_BY_PRODUCTION),
        between_two_steps,
        one_gate_after_the_other,
    ],
)
def test_the_order_of_production_shows_none_of_them(planted: Planted) -> None:
    """Else they would be no bugs that a test has to look for."""
    run_schedule(planted, Production(0), OWN, {})


@pytest.mark.parametrize("name", ["order_of_3", "missed_wake_up", "timer_tie", "restart_order"])
@pytest.mark.parametrize("tried", NAMES)
def test_every_strategy_finds_a_bug_of_few_turns(name: str, tried: str) -> None:
    assert runs_needed(PLANTED[name], tried) is not None


@pytest.mark.parametrize("count", [3, 4])
def test_priorities_find_an_order_as_often_as_they_promise(count: int) -> None:
    """Of depth d among n tasks and k choices: at least 1 / (n k^(d-1)) of the runs. Here n = count + 2, d = count."""
    hits, runs = 0, 400
    for seed in range(runs):
        try:
            run_schedule(order_of(count), Priorities(seed, count, 2 * count), OWN, {}, looks=False)
        except AssertionError:
            hits += 1
    assert hits / runs >= 1 / ((count + 2) * (2 * count) ** (count - 1))


def test_priorities_that_change_find_what_no_order_of_priorities_shows() -> None:
    """At least 1 / (n k) of the runs, with n = 3 tasks (the test's is one) and k choices, as the first run tells."""

    def hits(depth: int) -> tuple[int, int]:
        tried, found, longest = strategy("pct", depth), 0, 0
        for number in range(300):
            choices = tried.choices(number)
            assert choices is not None
            try:
                tried.learn(choices, run_schedule(between_two_steps, choices, OWN, {}, looks=False).trace)
                longest = max(longest, choices.steps)
            except AssertionError:
                found += 1
        return found, longest

    assert hits(1)[0] == 0
    found, longest = hits(2)
    assert found / 300 >= 1 / (3 * longest)


def test_what_was_new_is_built_on() -> None:
    assert runs_needed(one_gate_after_the_other, "coverage") is not None
    assert runs_needed(one_gate_after_the_other, "mixed") is None


def test_the_exhaustive_search_sees_each_order_and_ends() -> None:
    """Three tellers and one who notes: 3! orders of telling; when each is noted changes nothing."""
    orders: Counter[tuple[int, ...]] = Counter()

    async def tells(system: GuardedSystem) -> None:
        note = system.spawn(hf.start(Note), "note")
        for number in range(3):
            system.spawn(hf.start(Teller, note, number), f"teller{number}").tell(Go())
        await idle(system)
        actor: Any = note._cell.actor
        orders[tuple(actor.got)] += 1

    search = ScheduleSearch(tells, OWN, SimulationSettings(1000, strategy="exhaustive"))
    search.run()
    assert search.is_complete
    assert set(orders) == set(itertools.permutations(range(3)))
    assert search.runs == 6


def test_an_exhaustive_search_that_is_not_over_says_so() -> None:
    with pytest.warns(NotExhausted, match="2 schedules were tried, and there are more"):
        simulate(PLANTED["order_of_5"], strategy="exhaustive", seeds=2)()


def test_turns_that_have_nothing_to_do_with_each_other_are_not_tried_in_every_order() -> None:
    """Three pairs, each by itself: 6! / 2^3 = 90 orders, which are one."""

    async def pairs(system: GuardedSystem) -> None:
        for number in range(3):
            note = system.spawn(hf.start(Note), f"note{number}")
            system.spawn(hf.start(Teller, note, number), f"teller{number}").tell(Go())
        await idle(system)

    search = ScheduleSearch(pairs, OWN, SimulationSettings(1000, strategy="exhaustive"))
    search.run()
    assert search.is_complete
    assert search.runs == 1


@pytest.mark.parametrize("planted", [restart_order, order_of(4)])
def test_a_run_is_repeated_by_its_choices(planted: Planted) -> None:
    def run(choices: Any) -> Simulation:
        try:
            return run_schedule(planted, choices, OWN, {})
        except AssertionError as error:
            simulation: Simulation = error.__simulation__  # type: ignore[attr-defined]
            return simulation

    for seed in range(30):
        first = run(mixed(seed))
        again = run(Replay(seed, first.choices.kept()))
        assert again.trace == first.trace
        assert again.choices.kept() == first.choices.kept()


def test_a_schedule_is_a_line_of_text() -> None:
    taken = {"turn": {3: 1, 9: 2}, "fault": {1: 2}, "delay": {4: 63}}
    assert from_text(as_text(7, taken)) == (7, taken)
    for wrong in ("", "turn=1:2", "seed=x", "seed=1 turn=1", "seed=1 colour=1:2"):
        with pytest.raises(BadSchedule, match="not a schedule"):
            from_text(wrong)
    with pytest.raises(BadSchedule):
        simulate(restart_order, replay="seed")


def test_shrinking_leaves_what_it_takes() -> None:
    taken = {"turn": dict.fromkeys(range(1, 200), 1), "fault": dict.fromkeys(range(1, 50), 1)}

    def fails(tried: Taken) -> FailedRun | None:
        turns = tried.get("turn", {})
        return FailedRun(tried, 7, 2) if 17 in turns and 150 in turns and 30 in tried.get("fault", {}) else None

    assert shrink(taken, fails) == {"fault": {30: 1}, "turn": {150: 1, 17: 1}}


def test_of_equally_few_choices_those_with_the_fewest_turns_and_actors_are_left() -> None:
    def fails(tried: Taken) -> FailedRun | None:
        """It takes a hold, the earlier the shorter the run, and a delay; a short one takes another turn."""
        [*holds] = tried.get("hold", {})
        [*delays] = tried.get("delay", {}).values()
        if not holds or holds[0] < 9 or not delays or delays[0] < 5:
            return None
        return FailedRun(tried, 10 * holds[0] + (delays[0] < 20), 2 + (delays[0] > 40))

    assert shrink({"hold": {400: 2}, "delay": {3: 63}}, fails) == {"delay": {1: 20}, "hold": {9: 1}}


# -- what the world gives ---------------------------------------------------------------------------------------------


def test_random_numbers_and_clocks_are_the_seeds() -> None:
    def drawn(seed: int) -> list[object]:
        got: list[object] = []

        async def draws(system: GuardedSystem) -> None:
            got.extend([random.random(), uuid.uuid4(), os.urandom(4), random.SystemRandom().random()])
            got.extend([random.Random().random(), uuid.uuid1(), os.getrandom(4), numpy.random.random()])
            random.seed()
            got.extend([random.random(), numpy.random.default_rng().random()])
            await asyncio.sleep(2.5)
            got.extend([time.time(), time.monotonic(), time.perf_counter_ns()])
            got.extend([time.clock_gettime(time.CLOCK_REALTIME), time.process_time(), time.gmtime().tm_sec])

        run_schedule(draws, Production(seed), OWN, {})
        return got

    assert drawn(1) == drawn(1)
    assert not any(one == other for one, other in zip(drawn(1)[:10], drawn(2)[:10], strict=True))
    assert drawn(1)[10:] == [EPOCH + 2.5, 2.5, 2_500_000_000, EPOCH + 2.5, 2.5, 22]


def test_what_is_drawn_depends_on_no_library_that_is_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[bytes] = []

    async def draws(system: GuardedSystem) -> None:
        drawn.append(os.urandom(8))

    run_schedule(draws, Production(1), OWN, {})
    monkeypatch.delitem(sys.modules, "numpy.random")
    run_schedule(draws, Production(1), OWN, {})
    assert drawn[0] == drawn[1]


def test_the_world_is_as_it_was_when_the_run_is_over() -> None:
    def world() -> list[object]:
        functions = [
            time.time,
            time.localtime,
            os.urandom,
            os.fork,
            random.Random.seed,
            random.seed,
            socket.socket.__init__,
        ]
        return [*functions, threading.Thread.start, random.getstate(), str(numpy.random.get_state())]

    before = world()
    run_schedule(restart_order, Production(0), OWN, {})
    assert world() == before
    assert abs(time.time() - datetime.datetime.now().timestamp()) < 60.0


def test_a_thread_that_a_program_starts_is_told_by_name() -> None:
    def watches() -> None: ...

    async def starts(system: GuardedSystem) -> None:
        thread = threading.Thread(target=watches)
        thread.start()
        thread.join()

    with pytest.warns(EscapesSimulation, match="a thread was started .*watches"):
        run_schedule(starts, Production(0), OWN, {})


@pytest.mark.parametrize(
    ("escape", "told"),
    [
        (lambda: socket.socket().close(), "a socket was opened"),
        (lambda: subprocess.run(["true"], check=True), "a process was started"),
        (lambda: os.waitpid(os.posix_spawn("/bin/true", ["true"], {}), 0), r"a process was started \(os.posix_spawn\)"),
    ],
)
def test_what_another_process_or_a_socket_brings_is_told(escape: Callable[[], object], told: str) -> None:
    async def escapes(system: GuardedSystem) -> None:
        escape()

    with pytest.warns(EscapesSimulation, match=told):
        run_schedule(escapes, Production(0), OWN, {})


def test_a_server_is_told() -> None:
    async def serves(system: GuardedSystem) -> None:
        server = await asyncio.start_server(lambda *_: None, "127.0.0.1", 0)
        server.close()
        await server.wait_closed()

    with pytest.warns(EscapesSimulation) as told:
        run_schedule(serves, Production(0), OWN, {})
    assert any("a socket is read (asyncio." in str(one.message) for one in told)


def test_what_a_thread_brings_comes_when_nothing_else_can_happen() -> None:
    async def works(system: GuardedSystem, simulation: Simulation) -> None:
        note = system.spawn(hf.start(Note), "note")
        loop = asyncio.get_running_loop()
        jobs = [loop.run_in_executor(None, lambda: None) for _ in range(2)]
        for number in range(20):
            note.tell(Step(number))
            await asyncio.sleep(0)
        await asyncio.gather(*jobs)
        simulation.trace.append(("the job", "done"))

    for seed in range(20):
        trace = run_schedule(works, Walk(seed), {"system", "simulation"}, {}).trace
        assert trace.index(("the job", "done")) > max(at for at, turn in enumerate(trace) if turn[1] == "Step")


def test_what_threads_of_a_pool_bring_comes_in_the_order_in_which_it_was_asked_for() -> None:
    async def works(system: GuardedSystem) -> None:
        note, loop = system.spawn(hf.start(Note), "note"), asyncio.get_running_loop()
        gates = [threading.Event() for _ in range(3)]

        def work(number: int) -> int:
            gates[number].wait()
            if number:  # The last one ends first.
                gates[number - 1].set()
            return number

        jobs = [loop.run_in_executor(None, work, number) for number in range(3)]
        for job in jobs:
            job.add_done_callback(lambda done: note.tell(Step(done.result())))
        gates[-1].set()
        await asyncio.gather(*jobs)
        await idle(system)
        actor: Any = note._cell.actor
        assert actor.got == [0, 1, 2]

    simulate(works, seeds=20)()


def test_what_a_thread_has_brought_before_it_was_awaited_comes_no_earlier() -> None:
    class Quick(concurrent.futures.Executor):
        def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> concurrent.futures.Future[Any]:
            done: concurrent.futures.Future[Any] = concurrent.futures.Future()
            done.set_result(fn(*args, **kwargs))
            return done

    async def works(system: GuardedSystem, simulation: Simulation) -> None:
        note = system.spawn(hf.start(Note), "note")
        job = asyncio.get_running_loop().run_in_executor(Quick(), lambda: None)
        for number in range(20):
            note.tell(Step(number))
            await asyncio.sleep(0)
        await job
        simulation.trace.append(("the job", "done"))

    for seed in range(20):
        trace = run_schedule(works, Walk(seed), {"system", "simulation"}, {}).trace
        assert trace.index(("the job", "done")) > max(at for at, turn in enumerate(trace) if turn[1] == "Step")


def test_a_thread_of_a_pool_may_ask_what_takes_time() -> None:
    class Slow(hf.Actor):
        def __init__(self) -> None:
            self.got: list[int] = []

        @hf.on(Step)
        async def step(self, message: Step) -> None:
            await asyncio.sleep(60.0)
            self.got.append(message.number)

    async def asks(system: GuardedSystem) -> None:
        slow, inside = system.spawn(hf.start(Slow)), system.from_thread()

        def calls() -> None:
            inside.tell(slow, Step(1))
            inside.ask(slow, Step(2), 300.0)

        await asyncio.to_thread(calls)
        actor: Any = slow._cell.actor
        assert actor.got == [1, 2]

    simulate(asks, seeds=20)()


class Amount(hf.Message[int]):
    who: str
    cents: list[int]


DRAWN = itertools.count(1)
"""What no seed decides."""


class Till(hf.Actor):
    @hf.on(Amount)
    def amount(self, message: Amount) -> int:
        return next(DRAWN) if message.who == "nobody" else 0


@pytest.mark.parametrize(
    ("who", "isolation", "recovery"),
    [
        ("anna", "task", None),
        ("nobody", "task", None),
        ("anna", "process", None),
        ("nobody", "process", None),
        ("anna", "task", hf.hybrid()),
    ],
    ids=["a message", "a reply", "a message to a process", "a reply of a process", "a recorded message"],
)
def test_values_that_do_not_repeat_are_an_error_of_that_run(who: str, isolation: Any, recovery: Any) -> None:
    """Turns, actors and classes are the same each time."""

    async def counts(system: GuardedSystem) -> None:
        till = await system.start(hf.child("till", hf.start(Till), isolation=isolation, recovery=recovery))
        await till.ask(Amount(who, [7, 0 if who == "nobody" else next(DRAWN)]))

    field = "its value of the reply of /app/till to" if who == "nobody" else r"cents\[1\] of /app/till"
    with pytest.raises(NotRepeatable, match=rf"in turn \d+ {field} Amount was \d+, and the same choices then gave \d+"):
        simulate(counts, seeds=1)()


def test_what_no_codec_takes_is_compared_by_its_class() -> None:
    async def tells(system: GuardedSystem) -> None:
        till: Any = system.spawn(hf.start(Till), "till")
        system.expect_types()
        no_text: Any = object()
        await till.ask(Amount(no_text, []))

    simulate(tells, seeds=1)()


def test_a_run_that_does_not_repeat_is_an_error_of_that_run() -> None:
    seen: list[int] = []

    async def remembers(system: GuardedSystem) -> None:
        note = system.spawn(hf.start(Note), "note")
        seen.append(1)
        for _ in seen:
            note.tell(Step(1))
        await idle(system)

    with pytest.raises(NotRepeatable, match="cannot be repeated: turn 2 was"):
        simulate(remembers, seeds=1)()


def test_a_failure_that_does_not_repeat_says_so() -> None:
    seen: list[int] = []

    async def fails_once(system: GuardedSystem) -> None:
        seen.append(1)
        assert len(seen) > 1

    error = found(fails_once, seeds=1)
    assert "fails only sometimes" in "".join(error.__notes__)


# -- what is drawn is kept --------------------------------------------------------------------------------------------


def test_faults_and_their_delays_are_shrunk_too() -> None:
    async def loses(system: GuardedSystem, faults: Any) -> None:
        note = system.spawn(hf.start(Note), "note")
        with faults.on(note, at="admit", drop=0.2, delay=0.3, seconds=(0.1, 2.0)):
            for number in range(20):
                note.tell(Step(number))
            await asyncio.sleep(5.0)
        actor: Any = note._cell.actor
        assert len(actor.got) == 20

    [note] = found(loses).__notes__
    assert note.count("struck: drop") == 1
    assert "struck: delay" not in note
    _, taken = from_text(note.partition('replay="')[2].partition('"')[0])
    assert size(taken) == 1


def test_delays_differ_within_their_range() -> None:
    seconds: list[float] = []

    async def late(system: GuardedSystem, faults: Any) -> None:
        note = system.spawn(hf.start(Note), "note")
        loop = asyncio.get_running_loop()
        with faults.on(note, at="turn begin", delay=1.0, seconds=(0.5, 1.5)):
            for number in range(8):
                begin = loop.time()
                note.tell(Step(number))
                await idle(system)
                while len(note._cell.actor.got) <= number:  # type: ignore[union-attr]
                    await asyncio.sleep(0.01)
                seconds.append(loop.time() - begin)

    run_schedule(late, Walk(1), {"system", "faults"}, {})
    assert all(0.5 <= one <= 1.6 for one in seconds)
    assert len({round(one, 1) for one in seconds}) > 3


@pytest.mark.parametrize("seconds", [-1.0, (2.0, 1.0), float("inf")])
def test_a_delay_that_cannot_be_is_refused(seconds: Any) -> None:
    async def wrong(system: GuardedSystem, faults: Any) -> None:
        note = system.spawn(hf.start(Note), "note")
        with pytest.raises(hf.SpecError, match="seconds must be"):
            faults.on(note, at="admit", delay=1.0, seconds=seconds)

    run_schedule(wrong, Production(0), {"system", "faults"}, {})


@pytest.mark.parametrize("options", [{"strategy": "luck"}, {"depth": 0}])
def test_a_strategy_that_there_is_not_is_refused(options: dict[str, Any]) -> None:
    with pytest.raises(hf.SpecError, match="must be"):
        simulate(restart_order, **options)


def in_two_processes(player: str) -> list[list[str]]:
    """What a program prints where strings have other hashes."""
    runs = [
        subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name(player))],
            env={**os.environ, "PYTHONHASHSEED": seed, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            stdout=subprocess.PIPE,
        )
        for seed in ("1", "2")
    ]
    printed = [run.communicate(timeout=120)[0].decode().splitlines() for run in runs]
    assert [run.returncode for run in runs] == [0, 0]
    return printed


def test_no_order_of_a_set_changes_a_run() -> None:
    first, again = in_two_processes("hash_player.py")
    assert len(first) > 1000
    assert first == again


def test_a_set_of_refs_has_one_order_in_every_process() -> None:
    first, again = in_two_processes("refs_player.py")
    assert first == again
    assert first[1] == "True"
