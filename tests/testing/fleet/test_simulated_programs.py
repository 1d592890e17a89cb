"""A fleet under `@simulate`: one seed decides every step of all programs, their ends, and who reaches whom."""

from __future__ import annotations

import asyncio
import gc
import os
import warnings
from collections.abc import Callable
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.errors import Unreachable
from holdfast.actors.kernel.node import Clock
from holdfast.testing import Faults, Simulation, UnexpectedEnd, simulate
from holdfast.testing.fleet.guarded_fleet import GuardedFleet
from holdfast.testing.fleet.sim_fleet import SimFleet, SimProgram
from holdfast.testing.schedules.control import ControlledLoop
from holdfast.testing.schedules.disk import NoRootToKill
from holdfast.testing.simulation import Test, run_seed
from tests.testing.fleet.locks import give_recorded_locks, hold, two_hold_one_lock

SEEDS = int(os.environ.get("HOLDFAST_SIMULATED_FLEETS", "0"))
OWN = {"fleet", "simulation"}
RAN: list[str] = []
"""Who has run: programs of one test share it, as they do all globals."""


class Add(hf.Message[int]):
    number: int


class Fail(hf.Message[int]):
    pass


class Sum(hf.Actor):
    def __init__(self) -> None:
        self.total = 0

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.total += message.number
        return self.total

    @hf.on(Fail)
    def fail(self, message: Fail) -> int:
        raise ValueError("wrong")


class Beat(hf.Actor):
    """Runs each second, by a timer and by a task."""

    async def on_start(self, restored: bool) -> None:
        self.ctx.every(1.0, Add(0))
        self.ctx.create_task(self.go_on())

    async def go_on(self) -> None:
        try:
            while True:
                await asyncio.sleep(1.0)
                RAN.append("task")
        finally:
            RAN.append("end")

    @hf.on(Add)
    def beat(self, message: Add) -> int:
        RAN.append("timer")
        return 0


def program_of(*children: hf.ChildSpec[Any]) -> Callable[[SimProgram], Any]:
    """A program that has these children, and waits."""

    async def body(program: SimProgram) -> None:
        async with program.open() as system:
            for child in children:
                await system.start(child)
            await asyncio.Event().wait()

    return body


bank = program_of(hf.child("sum", hf.start(Sum), recovery=hf.hybrid(), isolation="process"))
plain = program_of(hf.child("sum", hf.start(Sum)))


async def led(fleet: SimFleet) -> SimProgram:
    """Wait until a program leads."""
    while (leader := fleet.leader()) is None:
        await asyncio.sleep(0.1)
    return leader


def fails(test: Test, **options: Any) -> str:
    """The failure of a simulated test, with its notes."""
    said: dict[str, Any] = {"seed": 0, **options}
    try:
        simulate(test, **said)()
    except Exception as error:
        return "\n".join([str(error), *error.__notes__])
    raise AssertionError("it passes")


async def kept(fleet: GuardedFleet, simulation: Simulation) -> None:
    """Programs, and processes of their actors, are killed while a client counts."""
    fleet.expect_crashes()
    for _ in range(2):
        fleet.start(bank, again=1.0)
    async with hf.connect(fleet.servers(), timeout=60.0) as connection:
        ref = connection.ref("/app/sum", Sum)
        asked = [ref.ask(Add(1), timeout=300.0) for _ in range(4)]
        leader = await led(fleet)
        await simulation.moment(20)
        if simulation.seed % 2:
            assert leader.system is not None
            simulation.kill_process(leader.system.ref("/app/sum"))
        else:
            fleet.kill(leader)
        assert await asyncio.gather(*asked) == [1, 2, 3, 4]
        assert await ref.ask(Add(1), timeout=300.0) == 5


def test_what_was_asked_is_done_once_whatever_is_killed() -> None:
    simulate(kept, seeds=6, latency=(0.0, 0.01))()


def test_clients_see_one_sum_that_never_failed() -> None:
    """Programs die, are cut off and left behind at any frame; and so are clients."""

    async def counts(fleet: GuardedFleet, faults: Faults) -> None:
        fleet.expect_crashes()
        odds: dict[str, Any] = {"crash": 0.02, "cut": 0.02, "split": 0.02, "seconds": (0.5, 10.0), "times": 4}
        async with faults.on(fleet, at="post", **odds), faults.on(fleet, at="request", **odds):
            for _ in range(2):
                fleet.start(bank, again=1.0)
            async with hf.connect(fleet.servers(), timeout=600.0) as connection:
                ref = connection.ref("/app/sum", Sum)
                assert [await ref.ask(Add(1), timeout=600.0) for _ in range(5)] == [1, 2, 3, 4, 5]

    simulate(counts, seeds=SEEDS or 3, latency=(0.0, 0.001))()


def test_the_order_of_turns_is_that_of_the_seed_in_all_programs() -> None:
    def turns(seed: int) -> list[tuple[str, str]]:
        return run_seed(kept, seed, OWN, {}).trace

    first, other = turns(2), turns(4)
    assert first == turns(2)
    assert first != other
    assert len({path.partition(":/")[0] for path, _ in first}) > 1, "one program led"
    assert all(path.startswith("program ") for path, _ in first)


def test_nothing_of_a_killed_program_runs() -> None:
    beats = program_of(
        hf.child("beat", hf.start(Beat)),
        hf.supervisor("top", children=[hf.child("beat", hf.start(Beat))], isolation="process"),
    )

    async def killed(fleet: GuardedFleet) -> None:
        RAN.clear()
        fleet.start(beats)
        system = (await led(fleet)).system
        assert system is not None
        await asyncio.sleep(3.5)
        assert {"task", "timer"} == set(RAN)
        asked = system.ref("/app/beat", Beat).ask(Add(1))
        fleet.kill(fleet.leader())
        RAN.clear()
        with pytest.raises(hf.AskFailed, match="was killed"):
            await asked
        await asyncio.sleep(5.0)
        assert RAN == []
        assert fleet.leader() is None

    simulate(killed, seeds=3)()


def test_who_stands_by_leaves_nothing_behind_when_it_is_killed() -> None:
    async def killed(fleet: GuardedFleet) -> None:
        fleet.start(plain)
        await led(fleet)
        second = fleet.start(plain)
        await asyncio.sleep(1.0)
        fleet.kill(second)
        await second.ended()

    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        simulate(killed, seed=0)()
        gc.collect()
    assert [str(one.message) for one in told] == []


def test_what_a_program_has_sent_arrives_after_its_end() -> None:
    async def killed(fleet: GuardedFleet) -> None:
        program = fleet.start(plain)
        async with hf.connect(fleet.servers(), timeout=60.0) as connection:
            ref = connection.ref("/app/sum", Sum)
            assert await ref.ask(Add(1)) == 1
            fleet.post.latency = (1.0, 1.0)
            asked = ref.ask(Add(1), timeout=20.0)
            await asyncio.sleep(1.5)
            fleet.kill(program)
            assert await asked == 2

    simulate(killed, seeds=2)()


@pytest.mark.parametrize("at", ["post", "request"])
def test_a_program_that_dies_where_it_sends_something_sends_nothing_more(at: str) -> None:
    async def struck(fleet: GuardedFleet, faults: Faults) -> None:
        first = fleet.start(plain)
        await led(fleet)
        async with hf.connect(fleet.servers(), timeout=60.0) as connection:
            ref = connection.ref("/app/sum", Sum)
            assert await ref.ask(Add(1)) == 1
            async with faults.on(first, at=at, crash=1.0):
                await asyncio.sleep(2.0)
                [strike] = faults.strikes
                assert strike.what.startswith("what program 1 sends to ")
                assert first.is_killed
                assert fleet.programs == []
            with pytest.raises((hf.AskTimeout, Unreachable)):
                await ref.ask(Add(1), timeout=10.0)

    simulate(struck, seeds=3)()


@pytest.mark.parametrize("kind", ["cut", "split"])
def test_who_is_cut_off_is_replaced_and_comes_back_when_that_is_over(kind: str) -> None:
    async def struck(fleet: GuardedFleet, faults: Faults) -> None:
        first = fleet.start(plain)
        await led(fleet)
        second = fleet.start(plain)
        await asyncio.sleep(1.0)
        odds: dict[str, Any] = {kind: 1.0}
        async with faults.on(first, at="request", times=1, seconds=10.0, **odds):
            await asyncio.sleep(9.0)
            is_left_too = "program 2" in faults.strikes[0].what
            assert first.leads
            assert second.leads != is_left_too
            await asyncio.sleep(30.0)
        assert [first.leads, second.leads].count(True) == 1

    simulate(struck, seeds=2)()


def test_two_that_are_cut_off_from_each_other_reach_all_others() -> None:
    async def cut(fleet: GuardedFleet) -> None:
        program, one, other = fleet.start(plain), fleet.servers(), fleet.servers()
        async with hf.connect(one, timeout=60.0) as near, hf.connect(other, timeout=60.0) as far:
            asked, heard = near.ref("/app/sum", Sum), far.ref("/app/sum", Sum)
            fleet.cut(program, one)
            with pytest.raises((hf.AskTimeout, Unreachable)):
                await asked.ask(Add(1), timeout=3.0)
            assert await heard.ask(Add(10)) == 10
            fleet.heal()
            await asyncio.sleep(10.0)
            assert await asked.ask(Add(1)) in (11, 12)
            over = fleet.split(one, other)  # They still have each other, and nobody else.
            for ref in (asked, heard):
                with pytest.raises((hf.AskTimeout, Unreachable)):
                    await ref.ask(Add(0), timeout=3.0)
            over()
            await asyncio.sleep(10.0)
            assert await heard.ask(Add(0)) in (11, 12)

    simulate(cut, seeds=2)()


def test_a_bug_that_a_split_shows_is_found_shrunk_and_shown() -> None:
    told = fails(two_hold_one_lock, seed=10)
    assert "holds the lock, and so does" in told
    assert "shrunk to 2 choices" in told
    assert "left behind: program 1, client" in told
    assert "program 1:lock" in told
    assert "program 2:lock" in told
    assert "left behind: program 1, client" in fails(two_hold_one_lock, seed=None, replay="seed=10 fault=3:1,6:1")


def test_an_actor_that_is_recorded_gives_no_lock_that_another_program_gives() -> None:
    async def recorded(fleet: GuardedFleet) -> None:
        first = fleet.start(give_recorded_locks)
        await led(fleet)
        fleet.start(give_recorded_locks)
        held: dict[str, float] = {}
        ann, bob = fleet.servers(), fleet.servers()
        clients = [
            asyncio.ensure_future(hold(servers, held, name, times=8, pause=2.0))
            for servers, name in ((ann, "ann"), (bob, "bob"))
        ]
        await asyncio.sleep(1.0)
        fleet.split(first, bob)
        await asyncio.gather(*clients)
        assert "ann" in held

    simulate(recorded, seeds=2)()


def test_what_goes_wrong_in_a_program_fails_the_test() -> None:
    async def crashes(fleet: GuardedFleet) -> None:
        fleet.start(plain)
        async with hf.connect(fleet.servers(), timeout=60.0) as connection:
            ref = connection.ref("/app/sum", Sum)
            with pytest.raises(hf.errors.RemoteCrash):
                await ref.ask(Fail())
            await ref.send(Fail())
            await asyncio.sleep(1.0)

    async def expects(fleet: GuardedFleet) -> None:
        fleet.expect_crashes(2)
        await crashes(fleet)

    async def ends(fleet: GuardedFleet) -> None:
        async def body(program: SimProgram) -> None:
            raise ValueError("it cannot begin")

        fleet.start(body)
        await asyncio.sleep(1.0)

    assert "2 crashes" in fails(crashes)
    simulate(expects, seed=1)()
    assert "it cannot begin" in fails(ends)
    with pytest.raises(UnexpectedEnd):
        simulate(crashes, seed=1)()


def test_every_system_of_a_test_is_the_seeds() -> None:
    """Also one that the test, or a program, opens by itself."""

    async def opens(fleet: GuardedFleet, simulation: Simulation) -> None:
        async def body(program: SimProgram) -> None:
            async with hf.ActorSystem("own", log=False) as system:
                await system.spawn(hf.start(Sum), "sum").ask(Add(1))

        fleet.start(body)
        async with hf.ActorSystem("other", log=False) as system:
            await system.spawn(hf.start(Sum), "sum").ask(Add(1))
        await asyncio.sleep(1.0)
        assert {("program 1:/own/sum", "Add"), ("/other/sum", "Add")} < set(simulation.trace)

    simulate(opens, seeds=2)()


def test_no_two_programs_draw_the_same_numbers() -> None:
    drawn: list[float] = []

    class Draws(hf.Actor):
        def on_start(self, restored: bool) -> None:
            drawn.append(self.ctx.random.random())

    async def draws(fleet: GuardedFleet) -> None:
        for name in ("one", "two"):
            fleet.start(program_of(hf.child("draws", hf.start(Draws))), name)
        await asyncio.sleep(1.0)

    for _ in range(2):
        run_seed(draws, 1, OWN - {"simulation"}, {})
    assert drawn[:2] == drawn[2:]
    assert len(set(drawn)) == 2


def test_both_a_system_and_a_fleet() -> None:
    async def uses(system: hf.ActorSystem, fleet: GuardedFleet, simulation: Simulation) -> None:
        fleet.start(program_of(hf.child("sum", hf.start(Sum))), "bank")
        mine = system.spawn(hf.start(Sum), "sum")
        async with hf.connect(fleet.servers("bank"), within=system, timeout=60.0) as connection:
            assert await connection.ref("/bank/sum", Sum).ask(Add(1)) == await mine.ask(Add(1))
        system = await simulation.crash_root()
        assert await system.spawn(hf.start(Sum)).ask(Add(2)) == 2

    simulate(uses, seeds=2)()


def test_what_does_not_fit_is_refused() -> None:
    async def own_fleet(system: hf.ActorSystem) -> None:
        async with SimFleet():
            pass

    async def no_root(fleet: GuardedFleet, simulation: Simulation) -> None:
        await simulation.crash_root()

    async def at_an_actor(system: hf.ActorSystem, faults: Faults) -> None:
        faults.on(system, at="post", cut=0.1)

    async def never_again(fleet: GuardedFleet) -> None:
        fleet.start(plain, again=-1.0)

    async def killed_twice(fleet: GuardedFleet) -> None:
        program = fleet.start(plain)
        fleet.kill(program)
        fleet.kill(program)

    async def process_of_nobody(fleet: GuardedFleet, simulation: Simulation) -> None:
        fleet.start(plain)
        system = (await led(fleet)).system
        assert system is not None
        simulation.kill_process(system.ref("/app/sum"))

    assert "that of a fleet are its own servers" in fails(never_again, store="simulated")
    assert "as the parameter `fleet`" in fails(own_fleet)
    assert "kill a program of its fleet" in fails(no_root)
    assert "'post' is a point of a simulated fleet" in fails(at_an_actor)
    assert "again= must be a number of seconds from 0 on, not -1.0" in fails(never_again)
    assert "takes a program that runs in this fleet" in fails(killed_twice)
    assert "it has no process of its own" in fails(process_of_nobody)
    with pytest.raises(NoRootToKill):
        simulate(no_root, seed=1)()
    with pytest.raises(hf.SpecError, match="strategy='exhaustive' is for actors of one system"):
        simulate(never_again, strategy="exhaustive")


def test_deadlines_are_on_the_clock_of_the_loop() -> None:
    """Of two processes, and of two programs, which on real machines read the machine's."""

    async def reads() -> tuple[float, float]:
        clock = Clock(asyncio.get_running_loop())
        await asyncio.sleep(5.0)
        return clock.machine(), clock.on_machine(7.0)

    with asyncio.Runner(loop_factory=ControlledLoop) as runner:
        assert runner.run(reads()) == (5.0, 7.0)
