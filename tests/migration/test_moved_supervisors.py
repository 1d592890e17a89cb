"""A supervisor is moved, with all below it, where it cannot just have another address: another one takes its place."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import os
import random
import signal
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.system.transaction.relocation import Gated
from holdfast.system.transaction.succession import Succession
from tests.actors.process.waiting import next_event
from tests.migration.far_places import IN_TIME, PLACES, Pump, processes, traveller
from tests.migration.travellers import KINDS, Add, Give, Later, Luggage, Stream, Traveller
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

pytestmark = pytest.mark.usefixtures("warm_programs")

# A refused or failed transaction ends with its block, which collects several steps.
# ruff: noqa: PT012


def team(kind: str, place: str, isolation: Any = "task", **flags: Any) -> hf.ChildSpec:
    """A supervisor with `one` at that place, and others before and behind it, on another level too."""
    more: dict[str, Any] = {} if KINDS[kind] is None else {"recovery": KINDS[kind]}
    inner = hf.supervisor("inner", children=[hf.child("two", hf.start(Traveller), **more)], intensity=99)
    children = [hf.child("zero", hf.start(Traveller), **more), traveller(kind, place), inner]
    options: dict[str, Any] = {"intensity": 99, **flags}
    return hf.supervisor("team", children=children, isolation=isolation, **options)


def spec_for(way: str, kind: str, place: str, **flags: Any) -> hf.ChildSpec:
    return team(kind, place, isolation_for(way), **flags)


RUNNING = [("zero", "running"), ("one", "running"), ("inner", "running")]


async def is_whole(system: hf.ActorSystem, at: str, homes: tuple[str, ...]) -> None:
    """All of it is there and nothing of it elsewhere, in the end."""
    async with asyncio.timeout(IN_TIME):
        while True:
            with contextlib.suppress(hf.errors.NoSuchActor, hf.ActorStopped, hf.AskFailed):
                told = {name: await below(system, f"/app/{name}") for name in homes}
                if told == {name: [("team", "running")] if name == at else [] for name in homes}:
                    inner = await below(system, f"/app/{at}/team/inner")
                    if await below(system, f"/app/{at}/team") == RUNNING and inner == [("two", "running")]:
                        return
            await asyncio.sleep(0.005)


@pytest.fixture
async def system() -> Any:
    async with hf.ActorSystem("app", log=False, intensity=1000) as running:
        yield running


@pytest.mark.pairs
@pytest.mark.parametrize("way", list(WAYS))
@pytest.mark.parametrize("kind", list(KINDS))
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.some(9)
async def test_all_below_it_go_with_all_they_have(system: hf.ActorSystem, place: str, kind: str, way: str) -> None:
    old, new = WAYS[way]
    await plant(system, old, spec_for(way, kind, place), old, new)
    refs = [system.ref(f"/app/{old}/team/{name}", Traveller) for name in ("zero", "one", "inner/two")]
    supervisor, (_, ref, _) = team_of(system), refs
    luggage, stream, pumps = Luggage(system, ref), Stream(ref), [Pump(refs[0]), Pump(refs[2])]
    await luggage.pack()
    await stream.reached(20)
    for to in (new, old, new):
        own = processes(system, ref)
        await move(system, to, way=way)
        assert supervisor.path == f"/app/{to}/team"
        assert [one.path for one in refs] == [f"/app/{to}/team/{name}" for name in ("zero", "one", "inner/two")]
        process = system.pid_of(supervisor)
        assert processes(system, ref) == ([process] if place == "task" else own)
        assert [system.pid_of(refs[0]), system.pid_of(refs[2])] == [process, process]
        await is_whole(system, to, (old, new))
        await stream.reached(20)
    await stream.stop()
    for pump in pumps:
        await pump.judge()
    seen = await luggage.unpack()
    stream.judge(seen["added"])


@pytest.mark.pairs
@pytest.mark.parametrize("way", list(WAYS))
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("victim", ["old", "new", "own", "team"])
@pytest.mark.parametrize("seed", range(6))
@pytest.mark.some(17)
async def test_who_is_killed_at_any_instant_loses_nothing(
    system: hf.ActorSystem, seed: int, victim: str, place: str, way: str
) -> None:
    old, new = WAYS[way]
    await plant(system, old, spec_for(way, "recorded", place), old, new)
    refs = [system.ref(f"/app/{old}/team/{name}", Traveller) for name in ("zero", "one", "inner/two")]
    pumps = [Pump(ref) for ref in refs]
    for pump in pumps:
        await pump.reached(5)
    moving = asyncio.ensure_future(move(system, new, way=way))
    rng = random.Random(seed)
    struck = system._node.loop.time() + rng.random() * 0.4
    while not moving.done() and system._node.loop.time() < struck:
        await asyncio.sleep(0)
    paths = [path for path in system.tree() if path.endswith("/team")]
    struck_at = {"own": rng.choice(refs).path, "team": rng.choice(paths), "old": f"/app/{old}", "new": f"/app/{new}"}
    with contextlib.suppress(hf.errors.NoSuchActor, ProcessLookupError):  # It lives nowhere just now.
        ref = system.ref(struck_at[victim], hf.Actor)
        pid = rng.choice(processes(system, ref))
        if pid != os.getpid():  # Else asks of those below fail while it is restarted, as in any restart.
            os.kill(pid, signal.SIGKILL)
    try:
        await moving
    except (hf.TransactionFailed, hf.TransactionRefused):
        await is_whole(system, old, (old, new))
        for pump in pumps:
            await pump.reached(5)
        await move(system, new, way=way)
    for pump in pumps:
        await pump.reached(5)
        await pump.judge()
    await is_whole(system, new, (old, new))
    assert [one.path for one in refs] == [f"/app/{new}/team/{name}" for name in ("zero", "one", "inner/two")]


@asynccontextmanager
async def program(store: str, way: str, place: str) -> AsyncGenerator[hf.ActorSystem]:
    async with hf.ActorSystem("app", store=f"sqlite:{store}", durability="os", log=False, intensity=99) as system:
        old, new = WAYS[way]
        await plant(system, old, spec_for(way, "recorded", place), old, new)
        yield system


async def killed(store: str, when: str, way: str, place: str) -> None:
    """The root is killed by a step in the middle of the move."""
    old, new = WAYS[way]
    async with program(store, way, place) as system:
        for name in ("zero", "one", "inner/two"):
            await system.ref(f"/app/{old}/team/{name}", Traveller).ask(Add(7))
        await move_and_die(system, new, when, way)


@pytest.mark.pairs
@pytest.mark.parametrize("way", list(WAYS))
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("when", WHENS)
@pytest.mark.some(12)
async def test_a_root_that_is_killed_has_all_of_it_at_one_of_the_two(
    tmp_path: Path, when: str, place: str, way: str
) -> None:
    old, new = WAYS[way]
    await dies(tmp_path, __name__, when, way, place)
    async with program(str(tmp_path / "store"), way, place) as system:
        at = new if when in IN_FORCE else old
        await is_whole(system, at, (old, new))
        check_is_where(system, when, way)
        for name in ("zero", "one", "inner/two"):
            ref = system.ref(f"/app/{at}/team/{name}", Traveller)
            assert await ref.ask(Add(1), IN_TIME) == 8
            assert (processes(system, ref) == [system.pid_of(team_of(system))]) == (place == "task" or name != "one")
            if at != old:  # Who knows only the address of before reaches it.
                assert await system.ref(f"/app/{old}/team/{name}", Traveller).ask(Add(1), IN_TIME) == 9


@pytest.mark.parametrize("way", list(WAYS))
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.some(9)
async def test_a_move_that_is_given_up_leaves_all_where_it_was(system: hf.ActorSystem, place: str, way: str) -> None:
    old, new = WAYS[way]
    await plant(system, old, spec_for(way, "plain", place), old, new)
    refs = [system.ref(f"/app/{old}/team/{name}", Traveller) for name in ("zero", "one", "inner/two")]
    pumps = [Pump(ref) for ref in refs]
    where, tree = [processes(system, ref) for ref in refs], system.tree()
    for _ in range(2):
        with pytest.raises(hf.TransactionFailed, match="there was a stone") as failed:
            await move(system, new, Stumble(), way=way)
        assert failed.value.kept == ()
        for pump in pumps:
            await pump.reached(5)
        assert ([processes(system, ref) for ref in refs], system.tree()) == (where, tree)
        await is_whole(system, old, (old, new))
        assert await team_of(system).ask(hf.StartChild(hf.child("more", hf.start(Traveller))), IN_TIME) is not None
        await team_of(system).ask(hf.TerminateChild("more"))
        await team_of(system).ask(hf.DeleteChild("more"))
    await move(system, new, way=way)
    for pump in pumps:
        await pump.judge()


@pytest.mark.parametrize("what", [Gated, Succession])
@pytest.mark.parametrize("way", ["far to near", "near to far", "to a process"])
async def test_what_cannot_be_let_go_of_keeps_nothing_else(
    system: hf.ActorSystem, way: str, what: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is told; the supervisor that was to take the place goes in any case, as the candidates of the others do."""
    give_up, stuck = what.give_up, list[Any]()

    async def fails_once(one: Any, *given: Any) -> Any:
        was_done = await give_up(one, *given)
        if not stuck and was_done is not False:  # Of those that are lent a process: one that has had it.
            stuck.append(one)
            raise hf.errors.CannotMove("/app/it", "it did not come to rest")
        return was_done

    old, new = WAYS[way]
    await plant(system, old, spec_for(way, "plain", "task"), old, new)
    refs = [system.ref(f"/app/{old}/team/{name}", Traveller) for name in ("zero", "one", "inner/two")]
    where, tree = [processes(system, ref) for ref in refs], system.tree()
    monkeypatch.setattr(what, "give_up", fails_once)
    with pytest.raises(hf.TransactionFailed, match="there was a stone") as failed:
        await move(system, new, Stumble(), way=way)
    assert len(stuck) == 1
    assert "it did not come to rest" in failed.value.kept[0]
    await is_whole(system, old, (old, new))
    assert ([processes(system, ref) for ref in refs], system.tree()) == (where, tree)
    await move(system, new, way=way)
    await is_whole(system, new, (old, new))


class Know(hf.Message[bool]):
    """Keep a ref; link with that actor and watch it."""

    other: hf.ActorRef[Any]


class Heard(hf.Message[list[str]]): ...


class Ask(hf.Message[int]):
    """How many children it has, by the ref that is kept, the address that it had, and the binding."""

    path: str


class Friend(hf.Actor):
    """Is tied to a supervisor in every way."""

    bound: hf.Binding[hf.Supervisor]

    def __init__(self) -> None:
        self.heard: list[str] = []

    @hf.on(Know)
    def know(self, message: Know) -> bool:
        self.ctx.trap_exits = True
        self.kept = message.other
        self.ctx.link(message.other)
        self.ctx.monitor(message.other)
        return True

    @hf.on(Ask)
    async def count(self, message: Ask) -> int:
        refs = (self.kept, self.ctx.find(message.path, hf.Supervisor), self.bound)
        counts = [await ref.ask(hf.supervision.CountChildren(), IN_TIME) for ref in refs]
        return min(one.active for one in counts)

    @hf.on(Heard, readonly=True)
    def tell_heard(self, message: Heard) -> list[str]:
        return self.heard

    def on_down(self, source: hf.ActorRef[Any], reason: hf.ExitReason, recovering: bool) -> None:
        self.heard.append("down")

    def on_exit(self, source: hf.ActorRef[Any], reason: hf.ExitReason) -> None:
        self.heard.append("exit")


async def hears(friend: hf.ActorRef[Friend], what: list[str]) -> None:
    async with asyncio.timeout(IN_TIME):
        while sorted(await friend.ask(Heard(), IN_TIME)) != what:
            await asyncio.sleep(0.005)


@pytest.mark.pairs
@pytest.mark.parametrize("way", list(WAYS))
@pytest.mark.parametrize("at", ["root", "process", "old", "new"])
@pytest.mark.some(12)
async def test_who_is_tied_to_it_is_tied_to_the_one_that_takes_its_place(
    system: hf.ActorSystem, at: str, way: str
) -> None:
    """Wherever that is: also beside it, and where it goes."""
    old, new = WAYS[way]
    await plant(system, old, spec_for(way, "plain", "task"), old, new)
    above = {"root": "/app", "process": "/app", "old": f"/app/{old}", "new": f"/app/{new}"}[at]
    isolation: Any = "process" if at == "process" else "task"
    async with system.transaction(timeout=IN_TIME) as change:
        change.add(above, hf.child("friend", hf.start(Friend), isolation=isolation))
    friend, supervisor = system.ref(f"{above}/friend", Friend), team_of(system)
    system.bind(friend, "bound", supervisor)
    system.register("the team", supervisor)
    assert await friend.ask(Know(supervisor), IN_TIME)
    for to in (new, old, new):
        before = supervisor.path
        await move(system, to, way=way)
        assert await friend.ask(Ask(before), IN_TIME) == 3
        assert system.whereis("the team").path == supervisor.path == f"/app/{to}/team"
        assert await friend.ask(Heard(), IN_TIME) == []
    await system.stop(supervisor)
    await hears(friend, ["down", "exit"])  # Once each.
    with pytest.raises(hf.errors.NoSuchActor):
        system.whereis("the team")


@pytest.mark.parametrize("way", list(WAYS))
async def test_restarts_before_the_move_count_behind_it(system: hf.ActorSystem, way: str) -> None:
    old, new = WAYS[way]
    await plant(system, old, spec_for(way, "plain", "task", intensity=2, period=3600.0), old, new)
    one = system.ref(f"/app/{old}/team/one", Traveller)

    async def fall() -> None:
        life = (await system.get_status(one, timeout=IN_TIME)).life
        one.kill()
        async with asyncio.timeout(IN_TIME):
            while True:
                with contextlib.suppress(hf.ActorStopped, hf.AskFailed):
                    if (await system.get_status(one, timeout=IN_TIME)).life > life:
                        return
                await asyncio.sleep(0.005)

    await fall()
    await move(system, new, way=way)
    await fall()
    with system.events() as events:
        one.kill()
        event = await next_event(events, hf.events.SupervisorGaveUp)
    assert event.address == f"/app/{new}/team"
    await is_whole(system, new, (old, new))


@pytest.mark.parametrize("way", list(WAYS))
async def test_its_flags_and_the_order_of_its_children_are_the_same(system: hf.ActorSystem, way: str) -> None:
    """`rest_for_one` restarts those behind the one that has ended, and no other."""
    old, new = WAYS[way]
    await plant(system, old, spec_for(way, "plain", "task", strategy="rest_for_one"), old, new)
    refs = [system.ref(f"/app/{old}/team/{name}", Traveller) for name in ("zero", "one", "inner/two")]
    await move(system, new, way=way)
    for ref in refs:
        assert await ref.ask(Add(1), IN_TIME) == 1
    refs[1].kill()
    async with asyncio.timeout(IN_TIME):
        while True:
            with contextlib.suppress(hf.ActorStopped, hf.AskFailed):
                if [(await system.get_state(ref, timeout=IN_TIME))["total"] for ref in refs] == [1, 0, 0]:
                    return
            await asyncio.sleep(0.005)


@pytest.mark.parametrize("way", list(WAYS))
@pytest.mark.parametrize("what", ["team", "inner", "home"])
async def test_its_next_life_has_all_children_and_so_has_that_of_its_own_supervisor(
    system: hf.ActorSystem, what: str, way: str
) -> None:
    old, new = WAYS[way]
    await plant(system, old, spec_for(way, "recorded", "process"), old, new)
    refs = [system.ref(f"/app/{old}/team/{name}", Traveller) for name in ("zero", "one", "inner/two")]
    for ref in refs:
        await ref.ask(Add(3))
    await move(system, new, way=way)
    above, name = {"team": (new, "team"), "inner": (f"{new}/team", "inner"), "home": ("", new)}[what]
    supervisor = system.ref(f"/app/{above}".rstrip("/"), hf.Supervisor)
    await supervisor.ask(hf.RestartChild(name, running=True), IN_TIME)
    await is_whole(system, new, (old, new))
    assert [await ref.ask(Add(1), IN_TIME) for ref in refs] == [4, 4, 4]


@pytest.mark.parametrize("way", list(WAYS))
@pytest.mark.some(3)
async def test_whom_it_is_asked_to_start_meanwhile_is_there_if_it_says_so(system: hf.ActorSystem, way: str) -> None:
    old, new = WAYS[way]
    await plant(system, old, spec_for(way, "plain", "task"), old, new)
    supervisor, started, is_over = team_of(system), list[str](), False

    async def start() -> None:
        while not is_over:
            name = f"more-{len(started)}"
            with contextlib.suppress(hf.ActorStopped, hf.AskFailed):
                await supervisor.ask(hf.StartChild(hf.child(name, hf.start(Traveller))), IN_TIME)
                started.append(name)
            await asyncio.sleep(0.1)

    starting = asyncio.create_task(start())
    for to in (new, old) * 3:
        with contextlib.suppress(hf.TransactionFailed, hf.TransactionRefused):  # The root does not know such a one.
            await move(system, to, way=way)
        there = list(started)
        assert set(there) <= {name for name, _ in await below(system, supervisor.path)}
    is_over = True
    await starting
    assert set(started) <= {name for name, state in await below(system, supervisor.path) if state == "running"}


async def test_what_cannot_begin_anew_is_refused_before_anything_is_done(system: hf.ActorSystem) -> None:
    await system.start(
        hf.supervisor("near", children=[hf.supervisor("deep", children=[hf.supervisor("inner", isolation="process")])])
    )
    await system.start(hf.supervisor("far", children=[hf.supervisor("inner")], isolation="process"))
    before = system.tree()
    why = "cannot hold another supervisor with a process"
    with pytest.raises(hf.TransactionRefused, match=why):
        async with system.transaction(timeout=IN_TIME) as change:
            change.move("/app/near/deep", "/app/far")
    with pytest.raises(hf.errors.CannotMove, match=why):
        await system.set_isolation(system.ref("/app/near/deep", hf.Supervisor), "process")
    with pytest.raises(hf.errors.CannotMove, match="its supervisor lives in another process"):
        await system.set_isolation(system.ref("/app/far/inner", hf.Supervisor), "process")
    with pytest.raises(hf.errors.CannotMove, match="nobody supervises it"):
        await system.set_isolation(system.ref("/app", hf.Supervisor), "process")
    await system.set_isolation(system.ref("/app/far", hf.Supervisor), "process")  # It has one.
    assert system.tree() == before


async def test_steps_about_one_that_begins_anew(system: hf.ActorSystem) -> None:
    """What is refused in the same transaction, and what goes along."""
    await plant(system, "near", team("plain", "task"), "near", "far", "other")

    def twice(change: hf.system.Change) -> None:
        change.move("/app/near/team", "/app/far")
        change.move("/app/far/team", "/app/other")

    def smaller(change: hf.system.Change) -> None:
        change.remove("/app/near/team/zero")
        change.move("/app/near/team", "/app/far")

    refused = {"move it once": twice, "it is changed by this very transaction": smaller}
    for why, steps in refused.items():
        with pytest.raises(hf.TransactionRefused, match=why):
            async with system.transaction(timeout=IN_TIME) as change:
                steps(change)
    one, zero = (system.ref(f"/app/near/team/{name}", Traveller) for name in ("one", "zero"))
    async with system.transaction(timeout=IN_TIME) as change:
        change.move(zero, "/app/other")
        change.move("/app/near/team", "/app/far")
        change.move(one, "/app/near")
        change.strategy("/app/far/team", "one_for_all")
        change.add("/app/far/team", hf.child("new", hf.start(Traveller)))
    assert (one.path, zero.path) == ("/app/near/one", "/app/other/zero")
    assert await one.ask(Add(1)) == await zero.ask(Add(1)) == 1
    told = [name for name, _ in await below(system, "/app/far/team")]
    assert sorted(told) == ["inner", "new"]


@pytest.mark.parametrize("place", PLACES)
async def test_a_dynamic_supervisor_goes_with_those_that_the_root_knows(system: hf.ActorSystem, place: str) -> None:
    await system.start(hf.supervisor("near", children=[hf.dynamic("team", intensity=99)], intensity=99))
    await system.start(hf.supervisor("far", isolation="process", intensity=99))
    supervisor = team_of(system)
    one = await supervisor.ask(hf.StartChild(traveller("recorded", place)), IN_TIME)
    two = await supervisor.ask(hf.StartChild(hf.start(Traveller)), IN_TIME)
    assert await one.ask(Add(2), IN_TIME) == await two.ask(Add(2), IN_TIME) == 2
    name = two.path.rpartition("/")[2]
    await move(system, "far")
    assert (one.path, two.path) == ("/app/far/team/one", f"/app/far/team/{name}")
    assert await one.ask(Add(2), IN_TIME) == await two.ask(Add(2), IN_TIME) == 4
    three = await supervisor.ask(hf.StartChild(hf.child("three", hf.start(Traveller))), IN_TIME)
    assert three.path == "/app/far/team/three"


async def test_a_dynamic_supervisor_goes_with_its_template(system: hf.ActorSystem) -> None:
    template = hf.child(None, hf.start(Traveller), recovery=KINDS["recorded"])
    await system.start(hf.supervisor("near", children=[hf.dynamic("team", template=template)], intensity=99))
    await system.start(hf.supervisor("far", isolation="process", intensity=99))
    supervisor = team_of(system)
    one = await supervisor.ask(hf.StartChild(), IN_TIME)
    assert await one.ask(Add(2), IN_TIME) == 2
    name = one.path.rpartition("/")[2]
    await move(system, "far")
    assert (one.path, await one.ask(Add(2), IN_TIME)) == (f"/app/far/team/{name}", 4)
    two = await supervisor.ask(hf.StartChild(), IN_TIME)
    assert two.path.startswith("/app/far/team/traveller-")
    assert two.path != one.path


async def test_a_journal_says_who_has_come_and_not_who_has_gone(system: hf.ActorSystem) -> None:
    for name in ("pool", "other"):
        await system.start(hf.dynamic(name, journal=True))
    one = await system.ref("/app/pool", hf.Supervisor).ask(hf.StartChild(traveller("recorded", "task")), IN_TIME)
    assert await one.ask(Add(2), IN_TIME) == 2
    async with system.transaction(timeout=IN_TIME) as change:
        change.move(one, "/app/other")
    for name in ("pool", "other"):
        await system.ref("/app", hf.Supervisor).ask(hf.RestartChild(name, running=True), IN_TIME)
    assert [path for path in system.tree() if path.endswith("/one")] == ["/app/other/one"]
    assert await one.ask(Add(2), IN_TIME) == 4


async def test_who_has_left_the_address_is_found_by_it_when_nobody_stays_there(system: hf.ActorSystem) -> None:
    """A supervisor that goes back, and does not: whoever knows only its first address reaches it as before."""
    await plant(system, "near", team("plain", "task"), "near", "far")
    await move(system, "far")
    with pytest.raises(hf.TransactionFailed):
        await move(system, "near", Stumble())
    assert await system.ref("/app/near/team", hf.Supervisor).ask(
        hf.supervision.CountChildren(), IN_TIME
    ) == await team_of(system).ask(hf.supervision.CountChildren(), IN_TIME)
    assert await system.ref("/app/near/team/one", Traveller).ask(Add(1), IN_TIME) == 1


@pytest.mark.parametrize("way", list(WAYS))
async def test_what_waits_for_it_is_answered_by_the_one_that_takes_its_place(system: hf.ActorSystem, way: str) -> None:
    old, new = WAYS[way]
    await plant(system, old, spec_for(way, "plain", "task"), old, new)
    supervisor, answers, is_over = team_of(system), list[int](), False

    async def ask() -> None:
        while not is_over:
            answers.append((await supervisor.ask(hf.supervision.CountChildren(), IN_TIME)).specs)

    asking = asyncio.create_task(ask())
    for to in (new, old) * 2:
        await move(system, to, way=way)
    is_over = True
    await asking
    assert set(answers) == {3}


class Loud(hf.Supervisor):
    """Notes each start and end of it."""

    def __init__(self, flags: Any, children: Any, file: str = "") -> None:
        super().__init__(flags, children)
        self.file = file

    async def on_start(self, restored: bool) -> None:
        await super().on_start(restored)
        self.note("start")

    def on_stop(self, reason: hf.ExitReason) -> None:
        self.note(f"stop {reason}")

    def note(self, text: str) -> None:
        with Path(self.file).open("a") as file:
            file.write(f"{text}\n")


@pytest.mark.parametrize("way", list(WAYS))
async def test_its_old_life_ends_and_tells_nobody_else(system: hf.ActorSystem, way: str, tmp_path: Path) -> None:
    old, new = WAYS[way]
    spec, file = spec_for(way, "plain", "task"), tmp_path / "said"
    start = hf.start(Loud, spec.start.args[0], spec.start.args[1], file=str(file))
    await plant(system, old, dataclasses.replace(spec, start=start), old, new)
    with system.events() as events:
        await move(system, new, way=way)
        expected = ["start", "start", f"stop shutdown (moved to /app/{new}/team)"]
        async with asyncio.timeout(IN_TIME):
            while file.read_text().splitlines() != expected:
                await asyncio.sleep(0.005)
        told = [
            event for event in events.take() if isinstance(event, (hf.events.ChildTerminated, hf.events.ChildRestarted))
        ]
    assert told == []


@pytest.mark.parametrize("way", list(WAYS))
async def test_who_has_come_meanwhile_is_not_left_behind(system: hf.ActorSystem, way: str) -> None:
    old, new = WAYS[way]
    await plant(system, old, spec_for(way, "plain", "task"), old, new)
    supervisor = team_of(system)

    async def come(system: hf.ActorSystem) -> None:
        await supervisor.ask(hf.StartChild(hf.child("late", hf.start(Traveller))), IN_TIME)

    with pytest.raises(hf.TransactionFailed, match="another child by now, 'late'"):
        async with system.transaction(timeout=IN_TIME) as change:
            change.step(Stumble(come))
            put(system, change, new, way)
    assert await below(system, supervisor.path) == [*RUNNING, ("late", "running")]
    assert await system.ref(f"/app/{old}/team/late", Traveller).ask(Add(1), IN_TIME) == 1


@pytest.mark.parametrize("way", list(WAYS))
async def test_a_ref_from_before_means_the_one_that_is_there_now(system: hf.ActorSystem, way: str) -> None:
    old, new = WAYS[way]
    await plant(system, old, spec_for(way, "plain", "task"), old, new)
    supervisor, friend = team_of(system), await system.start(hf.child("friend", hf.start(Friend)))
    await move(system, new, way=way)
    assert await friend.ask(Know(supervisor), IN_TIME)
    system.register("the team", supervisor)
    assert system.whereis("the team").path == f"/app/{new}/team"
    assert await friend.ask(Heard(), IN_TIME) == []
    supervisor.kill()
    await hears(friend, ["down", "exit"])
    await is_whole(system, new, (old, new))


@pytest.mark.parametrize("way", list(WAYS))
async def test_who_falls_when_its_supervisor_has_stood_down_is_restarted(system: hf.ActorSystem, way: str) -> None:
    """Its supervisor goes on for that, and stands down again."""
    old, new = WAYS[way]
    await plant(system, old, spec_for(way, "plain", "task"), old, new)
    one = system.ref(f"/app/{old}/team/one", Traveller)
    assert await one.ask(Add(3), IN_TIME) == 3

    async def fall(system: hf.ActorSystem) -> None:
        fallen = one._cell.living.ended()
        one.kill()
        await fallen

    await move(system, new, Stumble(fall), way=way)
    assert await one.ask(Add(3), IN_TIME) == 3
    await is_whole(system, new, (old, new))


class Strike(hf.system.Operation):
    """Kills the process of a supervisor at the commit."""

    verb = "strike"

    def __init__(self, path: str) -> None:
        super().__init__(path)
        self.path = path

    async def check(self, system: hf.ActorSystem, draft: Any) -> None: ...

    def commit(self, system: hf.ActorSystem) -> None:
        os.kill(system.pid_of(system.ref(self.path, hf.Supervisor)), signal.SIGKILL)


@pytest.mark.parametrize("what", ["team", "one"])
async def test_who_has_come_to_a_process_that_dies_at_once_begins_with_it(system: hf.ActorSystem, what: str) -> None:
    """Also below a supervisor that is itself below the one whose process it is."""
    await plant(system, "near", team("plain", "task"), "near")
    await system.start(hf.supervisor("far", children=[hf.supervisor("deep")], isolation="process", intensity=99))
    one = system.ref("/app/near/team/one", Traveller)
    async with system.transaction(timeout=IN_TIME) as change:
        change.move(one if what == "one" else "/app/near/team", "/app/far/deep")
        change.step(Strike("/app/far"))
    async with asyncio.timeout(IN_TIME):
        while True:
            with contextlib.suppress(hf.AskFailed, hf.ActorStopped):
                assert await one.ask(Add(1), IN_TIME) == 1
                break
            await asyncio.sleep(0.005)


@pytest.mark.parametrize("way", ["with its process", "to a task"])
async def test_a_promised_reply_comes_through_the_process_that_was_left_and_ends_it(
    system: hf.ActorSystem, way: str
) -> None:
    old, new = WAYS[way]
    await plant(system, old, spec_for(way, "plain", "task"), old, new)
    one, process = system.ref(f"/app/{old}/team/one", Traveller), Path(f"/proc/{system.pid_of(team_of(system))}")
    reply = one.ask(Later(), timeout=IN_TIME)
    assert await one.ask(Add(1), IN_TIME) == 1
    await move(system, new, way=way)
    assert await one.ask(Add(1), IN_TIME) == 2
    assert process.exists()
    assert await one.ask(Give(9), IN_TIME)
    assert await reply == 9
    async with asyncio.timeout(IN_TIME):
        while process.exists():
            await asyncio.sleep(0.005)


async def test_a_ref_to_who_had_left_it_before_means_that_one(system: hf.ActorSystem) -> None:
    """Also if that has begun anew since, so that its ref knows it by whom it was below."""
    await plant(system, "near", team("plain", "task", "process"), "near", "next", "far")
    one = system.ref("/app/near/team/one", Traveller)
    os.kill(system.pid_of(one), signal.SIGKILL)
    async with asyncio.timeout(IN_TIME):
        while True:
            with contextlib.suppress(hf.AskFailed, hf.ActorStopped):
                assert await one.ask(Add(1), IN_TIME) == 1
                break
            await asyncio.sleep(0.005)
    async with system.transaction(timeout=IN_TIME) as change:
        change.move(one, "/app/far")
    await move(system, "next")
    assert await one.ask(Add(1), IN_TIME) == 2


@pytest.mark.parametrize("way", list(WAYS))
async def test_the_new_one_is_restarted_however_often_the_old_one_was(system: hf.ActorSystem, way: str) -> None:
    old, new = WAYS[way]
    await plant(system, old, spec_for(way, "plain", "task"), old, new)
    for _ in range(3):
        await system.ref(f"/app/{old}", hf.Supervisor).ask(hf.RestartChild("team", running=True), IN_TIME)
    await move(system, new, way=way)
    team_of(system).kill()
    await is_whole(system, new, (old, new))
    assert await system.ref(f"/app/{new}/team/one", Traveller).ask(Add(1), IN_TIME) == 1
