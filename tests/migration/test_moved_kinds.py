"""Supervisors of every kind are moved into and out of processes, with what each of them knows."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import signal
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.migration.far_places import IN_TIME, processes
from tests.migration.kinds import SPECS, Clients, Own, Visits, is_as_before, leaf, leaves, plant_kind, shape
from tests.migration.travellers import Add, Seen, Traveller
from tests.migration.ways import (
    IN_FORCE,
    WAYS,
    WHENS,
    below,
    check_is_where,
    dies,
    isolation_for,
    move,
    move_and_die,
    plant,
    put,
    team_of,
)
from tests.system.trees import Stumble

SOME_WAYS = list(WAYS) if os.environ.get("HOLDFAST_CROSSED") else ["far to near", "near to far", "to a process"]
"""The others differ in what moves between the same places; `test_moved_supervisors` has all of them every time."""


@pytest.fixture
async def system() -> Any:
    async with hf.ActorSystem("app", log=False, intensity=1000) as running:
        yield running


@pytest.mark.pairs
@pytest.mark.parametrize("way", SOME_WAYS)
@pytest.mark.parametrize("kind", list(SPECS))
async def test_each_kind_goes_with_all_below_it_and_comes_back(system: hf.ActorSystem, kind: str, way: str) -> None:
    old, new = WAYS[way]
    await plant_kind(system, kind, way, old, new)
    team, before, clients = team_of(system), await shape(system, old, (old, new)), Clients(system, kind)
    await clients.reached(5)
    for to in (new, old, new):
        await move(system, to, way=way)
        assert team.path == f"/app/{to}/team"
        assert {name: ref.path for name, ref in clients.refs.items()} == {
            name: f"/app/{to}/team/{name}" for name in clients.refs
        }
        await is_as_before(system, to, (old, new), before)
        await clients.reached(5)
    await clients.judge()


@pytest.mark.pairs
@pytest.mark.parametrize("way", SOME_WAYS)
@pytest.mark.parametrize("kind", [kind for kind in SPECS if kind != "jobs"])  # It begins empty when it was killed.
@pytest.mark.parametrize("victim", ["old", "new", "own", "team"])
@pytest.mark.parametrize("seed", range(3))
async def test_who_is_killed_at_any_instant_loses_nothing(
    system: hf.ActorSystem, seed: int, victim: str, kind: str, way: str
) -> None:
    old, new = WAYS[way]
    await plant_kind(system, kind, way, old, new)
    before, clients = await shape(system, old, (old, new)), Clients(system, kind)
    await clients.reached(5)
    moving = asyncio.ensure_future(move(system, new, way=way))
    rng = random.Random(seed)
    struck = system._node.loop.time() + rng.random() * 0.4
    while not moving.done() and system._node.loop.time() < struck:
        await asyncio.sleep(0)
    tops = [path for path in system.tree() if path.endswith("/team")]
    struck_at = {"own": rng.choice(list(clients.refs.values())).path, "team": rng.choice([*tops, f"/app/{old}/team"])}
    struck_at |= {"old": f"/app/{old}", "new": f"/app/{new}"}
    with contextlib.suppress(hf.errors.NoSuchActor, ProcessLookupError):  # It lives nowhere just now.
        pid = rng.choice(processes(system, system.ref(struck_at[victim], hf.Actor)))
        if pid != os.getpid():  # Else asks of those below fail while it is restarted, as in any restart.
            os.kill(pid, signal.SIGKILL)
    try:
        await moving
    except (hf.TransactionFailed, hf.TransactionRefused):
        await is_as_before(system, old, (old, new), before)
        await clients.reached(5)
        await move(system, new, way=way)
    await is_as_before(system, new, (old, new), before)
    await clients.reached(5)
    await clients.judge()


@asynccontextmanager
async def program(store: str, kind: str, way: str) -> AsyncGenerator[hf.ActorSystem]:
    async with hf.ActorSystem("app", store=f"sqlite:{store}", durability="os", log=False, intensity=99) as system:
        old, new = WAYS[way]
        await plant(system, old, SPECS[kind](isolation_for(way)), old, new)
        yield system


async def killed(store: str, when: str, kind: str, way: str) -> None:
    """The root is killed by a step in the middle of the move."""
    old, new = WAYS[way]
    async with program(store, kind, way) as system:
        if kind == "template":
            for _ in range(2):
                await team_of(system).ask(hf.StartChild(), IN_TIME)
        if kind == "journal":
            await system.ref(f"/app/{old}/team/below", hf.Supervisor).ask(hf.StartChild(leaf("one")), IN_TIME)
        for name in leaves(system):
            await system.ref(f"/app/{old}/team/{name}", Traveller).ask(Add(7))
        await move_and_die(system, new, when, way)


COUNTS = {"own": 2, "pool": 2, "partitions": 3, "template": 2, "journal": 1, "stopped": 2}


@pytest.mark.pairs
@pytest.mark.parametrize("way", SOME_WAYS)
@pytest.mark.parametrize("kind", list(COUNTS))
@pytest.mark.parametrize("when", WHENS)
@pytest.mark.some(12)
async def test_a_root_that_is_killed_has_all_of_it_at_one_of_the_two(
    tmp_path: Path, when: str, kind: str, way: str
) -> None:
    old, new = WAYS[way]
    await dies(tmp_path, __name__, when, kind, way)
    async with program(str(tmp_path / "store"), kind, way) as system:
        at = new if when in IN_FORCE else old
        assert team_of(system).path == f"/app/{at}/team"
        check_is_where(system, when, way)
        names = leaves(system)
        assert len(names) == COUNTS[kind]
        for name in names:
            assert await system.ref(f"/app/{at}/team/{name}", Traveller).ask(Add(1), IN_TIME) == 8
            if at != old:  # Who knows only the address of before reaches it.
                assert await system.ref(f"/app/{old}/team/{name}", Traveller).ask(Add(1), IN_TIME) == 9


@pytest.mark.pairs
@pytest.mark.parametrize("way", SOME_WAYS)
@pytest.mark.parametrize("kind", [kind for kind in SPECS if kind != "jobs"])
@pytest.mark.parametrize("what", ["team", "home"])
async def test_its_next_life_has_all_children(system: hf.ActorSystem, what: str, kind: str, way: str) -> None:
    old, new = WAYS[way]
    await plant_kind(system, kind, way, old, new)
    before, names = await shape(system, old, (old, new)), leaves(system)
    for name in names:
        await system.ref(f"/app/{old}/team/{name}", Traveller).ask(Add(3), IN_TIME)
    await move(system, new, way=way)
    supervisor, name = (f"/app/{new}", "team") if what == "team" else ("/app", new)
    await system.ref(supervisor, hf.Supervisor).ask(hf.RestartChild(name, running=True), IN_TIME)
    await is_as_before(system, new, (old, new), before)
    for name in names:
        assert await system.ref(f"/app/{new}/team/{name}", Traveller).ask(Add(1), IN_TIME) == 4


@pytest.mark.pairs
@pytest.mark.parametrize("way", SOME_WAYS)
@pytest.mark.parametrize("kind", list(SPECS))
async def test_a_move_that_is_given_up_leaves_all_where_it_was(system: hf.ActorSystem, kind: str, way: str) -> None:
    old, new = WAYS[way]
    await plant_kind(system, kind, way, old, new)
    before, clients = await shape(system, old, (old, new)), Clients(system, kind)
    tree = system.tree()
    for _ in range(2):
        with pytest.raises(hf.TransactionFailed, match="there was a stone") as failed:
            await move(system, new, Stumble(), way=way)
        assert failed.value.kept == ()
        await clients.reached(5)
        assert system.tree() == tree
        await is_as_before(system, old, (old, new), before)
    await move(system, new, way=way)
    await clients.judge()


@pytest.mark.parametrize("way", SOME_WAYS)
@pytest.mark.parametrize("kind", ["template", "journal", "pool"])
async def test_what_was_noted_is_true_when_a_move_was_given_up(system: hf.ActorSystem, kind: str, way: str) -> None:
    """The one that was to take the place has noted nothing, and erased nothing."""
    old, new = WAYS[way]
    await plant_kind(system, kind, way, old, new)
    if kind == "pool":
        await system.ref(f"/app/{old}/team/below", hf.Supervisor).ask(hf.supervision.ResizePool(3), IN_TIME)
    before, names = await shape(system, old, (old, new)), leaves(system)
    for name in names:
        assert await system.ref(f"/app/{old}/team/{name}", Traveller).ask(Add(3), IN_TIME) == 3
    with pytest.raises(hf.TransactionFailed, match="there was a stone"):
        await move(system, new, Stumble(), way=way)
    await system.ref(f"/app/{old}", hf.Supervisor).ask(hf.RestartChild("team", running=True), IN_TIME)
    await is_as_before(system, old, (old, new), before)
    for name in names:
        assert await system.ref(f"/app/{old}/team/{name}", Traveller).ask(Add(1), IN_TIME) == 4


@pytest.mark.parametrize("way", SOME_WAYS)
@pytest.mark.parametrize("kind", ["template", "journal"])
async def test_what_was_noted_goes_along(system: hf.ActorSystem, kind: str, way: str) -> None:
    old, new = WAYS[way]
    await plant_kind(system, kind, way, old, new)
    before = await shape(system, old, (old, new))
    for to in (new, old):
        await move(system, to, way=way)
        await system.ref(f"/app/{to}", hf.Supervisor).ask(hf.RestartChild("team", running=True), IN_TIME)
        await is_as_before(system, to, (old, new), before)


@pytest.mark.parametrize("way", list(WAYS))
async def test_one_with_an_init_of_its_own_keeps_its_state(system: hf.ActorSystem, way: str) -> None:
    old, new = WAYS[way]
    await plant_kind(system, "own", way, old, new)
    team = system.ref(f"/app/{old}/team", Own)
    for to, visits in ((new, 11), (old, 12), (new, 13)):
        assert await team.ask(Visits(), IN_TIME) == visits
        await move(system, to, way=way)
    assert (await system.get_state(team, timeout=IN_TIME))["visits"] == 13
    team.kill()  # Its next life begins as its recipe says.
    async with asyncio.timeout(IN_TIME):
        while True:
            with contextlib.suppress(hf.ActorStopped, hf.AskFailed):
                assert await team.ask(Visits(), IN_TIME) == 11
                return


class Unsavable(Own):
    """Has something in its state that is of its process."""

    def __init__(self, first: int) -> None:
        super().__init__(first)
        self.loop = asyncio.get_running_loop()


@pytest.mark.parametrize("way", list(WAYS))
async def test_state_that_cannot_be_saved_begins_afresh(system: hf.ActorSystem, way: str) -> None:
    old, new = WAYS[way]
    await plant(system, old, hf.child("team", hf.start(Unsavable, 5), isolation=isolation_for(way)), old, new)
    team = system.ref(f"/app/{old}/team", Own)
    assert await team.ask(Visits(), IN_TIME) == 6
    await move(system, new, way=way)
    assert await team.ask(Visits(), IN_TIME) == 6


@pytest.mark.parametrize("way", list(WAYS))
async def test_a_suspended_one_stays_suspended(system: hf.ActorSystem, way: str) -> None:
    old, new = WAYS[way]
    inner = hf.supervisor("inner", children=[leaf("one")])
    spec = hf.supervisor("team", children=[leaf("zero"), inner], isolation=isolation_for(way))
    await plant(system, old, spec, old, new)
    team, one = team_of(system), system.ref(f"/app/{old}/team/inner/one", Traveller)
    for to in (new, old, new):
        await system.suspend(team)
        waiting = team.ask(hf.supervision.CountChildren(), IN_TIME)
        async with asyncio.timeout(IN_TIME):
            await move(system, to, way=way)
        assert await one.ask(Add(1), IN_TIME) > 0
        assert (await system.get_status(team, timeout=IN_TIME)).state == "suspended"
        assert not waiting.done()
        await system.resume(team)
        assert (await waiting).active == 2


class Flop(hf.Actor):
    """Falls at its first message, as often as is wanted."""

    def __init__(self, file: str, times: int) -> None:
        self._file, self._times = file, times

    @hf.on(Add)
    def add(self, message: Add) -> int:
        with Path(self._file).open("a") as file:
            file.write("x")
        if Path(self._file).stat().st_size <= self._times:
            raise RuntimeError("flop")
        return message.n


@pytest.mark.parametrize("way", list(WAYS))
async def test_who_waits_for_a_restart_goes_with_its_next_life(
    system: hf.ActorSystem, way: str, tmp_path: Path
) -> None:
    """It does not wait to the end, once."""
    old, new = WAYS[way]
    start = hf.start(Flop, str(tmp_path / "said"), 1)
    children = [hf.child("flop", start, backoff=hf.Backoff(3600.0, 3600.0)), leaf("one")]
    spec = hf.supervisor("team", children=children, isolation=isolation_for(way), intensity=9)
    await plant(system, old, spec, old, new)
    flop = system.ref(f"/app/{old}/team/flop", Flop)
    with pytest.raises(hf.RemoteCrash):
        await flop.ask(Add(1), IN_TIME)
    async with asyncio.timeout(IN_TIME):
        while dict(await below(system, f"/app/{old}/team"))["flop"] != "restarting":
            await asyncio.sleep(0.005)
    waiting = flop.ask(Add(5), IN_TIME)
    await move(system, new, way=way)
    assert await waiting == 5
    assert await below(system, f"/app/{new}/team") == [("flop", "running"), ("one", "running")]


async def nap(seconds: float) -> float:
    await asyncio.sleep(seconds)
    return seconds


@pytest.mark.parametrize("way", ["near to far", "to a process"])
async def test_jobs_that_run_are_waited_for(system: hf.ActorSystem, way: str) -> None:
    old, new = WAYS[way]
    await plant(system, old, hf.supervision.tasks("team"), old, new)
    team: Any = team_of(system)
    jobs, end = hf.supervision.Tasks(team), asyncio.Event()
    job = jobs.start(end.wait)
    await asyncio.wait_for(started(system, 1), IN_TIME)

    async def end_soon(system: hf.ActorSystem) -> None:
        system._node.loop.call_later(0.3, end.set)

    await move(system, new, Stumble(end_soon), way=way)
    assert job.is_done
    assert await job is True
    with pytest.raises(hf.SpecError, match="lives in another process"):
        await jobs.run(nap, 0.1)


async def started(system: hf.ActorSystem, count: int) -> None:
    while len(await below(system, team_of(system).path)) < count:
        await asyncio.sleep(0.005)


@pytest.mark.parametrize("way", ["near to far", "to a process"])
async def test_jobs_begin_again_when_a_move_was_given_up(system: hf.ActorSystem, way: str) -> None:
    """Those that were asked for meanwhile have waited."""
    old, new = WAYS[way]
    await plant(system, old, hf.supervision.tasks("team"), old, new)
    team: Any = team_of(system)
    jobs = hf.supervision.Tasks(team)
    long = jobs.start(nap, 3600.0)
    await asyncio.wait_for(started(system, 1), IN_TIME)

    async def moved() -> None:
        async with system.transaction(timeout=0.5) as change:
            put(system, change, new, way)

    moving = asyncio.ensure_future(moved())
    await asyncio.sleep(0.1)
    next_one = asyncio.ensure_future(jobs.run(nap, 0.01))
    with pytest.raises(hf.TransactionFailed, match=r"its job 'nap-\w+-\d+' is not over"):
        await moving
    assert await asyncio.wait_for(next_one, IN_TIME) == 0.01
    await long.stop(0.0)


@pytest.mark.parametrize("way", ["near to far", "far to near", "to a process", "to a task"])
async def test_a_pool_that_has_grown_keeps_its_size_and_begins_with_the_first(system: hf.ActorSystem, way: str) -> None:
    old, new = WAYS[way]
    worker = hf.child(None, hf.start(Traveller))
    pool = hf.supervision.pool("below", worker, 2, intensity=99)
    await plant(system, old, hf.supervisor("team", children=[pool], isolation=isolation_for(way)), old, new)
    assert await system.ref(f"/app/{old}/team/below", hf.Supervisor).ask(hf.supervision.ResizePool(4), IN_TIME) == 2
    await move(system, new, way=way)
    supervisor = system.ref(f"/app/{new}/team/below", hf.Supervisor)
    told = await supervisor.ask(hf.supervision.PoolInfo(), IN_TIME)
    assert (told.size, told.up) == (4, 4)
    router = hf.supervision.pool_of(system, f"/app/{new}/team/below", Traveller)
    for _ in range(8):
        await router.ask(Add(1), IN_TIME)
    seen = [(await system.ref(f"{supervisor.path}/{n}", Traveller).ask(Seen(), IN_TIME))["added"] for n in range(4)]
    assert seen == [[1, 1]] * 4
    assert await supervisor.ask(hf.supervision.ResizePool(3), IN_TIME) == 4
    await system.ref(f"/app/{new}/team", hf.Supervisor).ask(hf.RestartChild("below", running=True), IN_TIME)
    assert (await supervisor.ask(hf.supervision.PoolInfo(), IN_TIME)).size == 2


@pytest.mark.parametrize("way", list(WAYS))
async def test_partitions_route_as_before(system: hf.ActorSystem, way: str) -> None:
    old, new = WAYS[way]
    await plant_kind(system, "partitions", way, old, new)
    team = team_of(system)
    assert await team.ask(hf.supervision.ResizePartitions(2), IN_TIME) == 3
    for to in (new, old, new):
        first = [(await team.ask(hf.supervision.Route(key), IN_TIME)).path.rpartition("/")[2] for key in range(6)]
        await move(system, to, way=way)
        assert await team.ask(hf.supervision.CountPartitions(), IN_TIME) == 2
        assert [
            (await team.ask(hf.supervision.Route(key), IN_TIME)).path.rpartition("/")[2] for key in range(6)
        ] == first
    assert await team.ask(hf.supervision.ResizePartitions(3), IN_TIME) == 2
    assert dict(await below(system, team.path)) == dict.fromkeys("012", "running")


async def test_what_a_process_alone_says_of_a_binding_makes_no_grant(system: hf.ActorSystem) -> None:
    """A child that was started there by a message, and is bound to somebody, stays there."""
    from tests.system.trees import Client, Counter

    await system.start(hf.child("bank", hf.start(Counter)))
    await system.start(hf.supervisor("near", intensity=9))
    await system.start(hf.dynamic("far", isolation="process", intensity=9))
    supervisor = system.ref("/app/far", hf.Supervisor)
    await supervisor.ask(hf.StartChild(hf.child("free", hf.start(Counter))), IN_TIME)
    await supervisor.ask(hf.StartChild(hf.child("bound", hf.start(Client), bindings={"peer": "/app/bank"})), IN_TIME)
    async with system.transaction(timeout=IN_TIME) as change:
        change.move("/app/far/free", "/app/near")
    with pytest.raises(hf.TransactionRefused, match="cannot tell one that has bindings"):
        async with system.transaction(timeout=IN_TIME) as change:
            change.move("/app/far/bound", "/app/near")
    assert "/app/far/bound" in system.tree()


class Patient(hf.Supervisor):
    """Puts aside what it is asked, until somebody says how often it was asked."""

    @hf.on(Add)
    def add(self, message: Add) -> int:
        if not getattr(self, "_is_open", False):
            self.ctx.stash()
            return 0
        return message.n

    @hf.on(Visits)
    def visit(self, message: Visits) -> int:
        self._is_open = True
        self.ctx.unstash()
        return 0


@pytest.mark.parametrize("way", list(WAYS))
async def test_what_it_has_put_aside_goes_along(system: hf.ActorSystem, way: str) -> None:
    old, new = WAYS[way]
    flags = hf.supervision.Flags(intensity=9)
    spec = hf.child("team", hf.start(Patient, flags, (leaf("one"),)), isolation=isolation_for(way))
    await plant(system, old, spec, old, new)
    team = system.ref(f"/app/{old}/team", Patient)
    waiting = [team.ask(Add(number), IN_TIME) for number in range(3)]
    assert (await team.ask(hf.supervision.CountChildren(), IN_TIME)).active == 1
    await move(system, new, way=way)
    assert await team.ask(Visits(), IN_TIME) == 0
    assert await asyncio.gather(*waiting) == [0, 1, 2]


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_journal_says_which_supervisor_has_come(system: hf.ActorSystem, isolation: Any) -> None:
    """And which has gone; one that was to come, and has not, is in none."""
    team = hf.supervisor("team", children=[leaf("one"), hf.supervisor("inner", isolation="task")], intensity=9)
    await system.start(hf.supervisor("near", children=[team], intensity=9))
    await system.start(hf.dynamic("noted", journal=True, isolation=isolation, intensity=9))
    one, before = system.ref("/app/near/team/one", Traveller), {"team": [("one", "running"), ("inner", "running")]}
    assert await one.ask(Add(3), IN_TIME) == 3

    async def restarted(at: str) -> None:
        await system.ref("/app", hf.Supervisor).ask(hf.RestartChild("noted", running=True), IN_TIME)
        await is_as_before(system, at, ("near", "noted"), before)

    with pytest.raises(hf.TransactionFailed, match="there was a stone"):
        await move(system, "noted", Stumble())
    await restarted("near")

    async def strike(system: hf.ActorSystem) -> None:
        if isolation == "process":  # It is not to come back with whom it was to have.
            os.kill(system.pid_of(system.ref("/app/noted", hf.Supervisor)), signal.SIGKILL)

    await move(system, "noted", Stumble(strike))
    await restarted("noted")
    assert await system.ref("/app/noted/team/one", Traveller).ask(Add(3), IN_TIME) == 6
    await move(system, "near")
    await restarted("near")
    assert await system.ref("/app/near/team/one", Traveller).ask(Add(3), IN_TIME) == 9


@pytest.mark.parametrize("way", list(WAYS))
async def test_who_was_stopped_by_order_is_known_as_such(system: hf.ActorSystem, way: str) -> None:
    """Repair leaves it alone."""
    old, new = WAYS[way]
    spec = hf.supervisor("team", children=[leaf("one"), leaf("two")], isolation=isolation_for(way), intensity=9)
    await plant(system, old, spec, old, new)
    await team_of(system).ask(hf.TerminateChild("two"), IN_TIME)
    await move(system, new, way=way)
    assert await below(system, f"/app/{new}/team") == [("one", "running"), ("two", "stopped")]
    with pytest.raises(hf.errors.ChildParked):
        await team_of(system).ask(hf.RestartChild("two", unless_parked=True), IN_TIME)
    assert await team_of(system).ask(hf.RestartChild("two"), IN_TIME) is not None
