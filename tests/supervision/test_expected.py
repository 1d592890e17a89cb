"""Children that come back with their dynamic supervisor are found as soon as it knows them, whatever they wait for.

The matrix: what a child is x why it does not start at once x how its supervisor came to start.
"""

from __future__ import annotations

import asyncio
import contextlib
import signal
from pathlib import Path

import pytest

import holdfast as hf
from holdfast.console.service.health import Service
from holdfast.testing import GuardedSystem, Simulation, advance, simulate
from tests.launched import ended
from tests.supervision.expected_player import (
    KINDS,
    PATH,
    RECORDED,
    WAITS,
    Add,
    Desk,
    Guest,
    Look,
    Slow,
    Speaker,
    Starter,
    Tell,
    add,
    come,
    guest,
    let_come,
    program,
)

pytestmark = pytest.mark.usefixtures("warm_programs")

ROOT = Path(__file__).parents[2]


@pytest.fixture
def file(tmp_path: Path) -> str:
    return str(tmp_path / "goes_on")


@pytest.mark.parametrize("why", WAITS)
@pytest.mark.parametrize("kind", KINDS)
async def test_in_the_next_program(kind: str, why: str, tmp_path: Path, file: str) -> None:
    store = f"sqlite:{tmp_path}/store"
    async with program(store) as system:
        await system.start(hf.dynamic("guests", journal=True))
        await add(system, kind, why, file)
    async with program(store) as system:
        guests = await come(system)
        ref = system.ref(PATH, Guest)
        ref.tell(Add(1))
        asked = ref.ask(Add(10), 30.0)
        assert await system.ref("/app/speaker", Speaker).ask(Look()) == PATH
        with pytest.raises(hf.errors.WrongActor):
            system.ref(PATH, Desk)
        with pytest.raises(hf.errors.UnknownMessage):
            ref.tell(Look())
        with pytest.raises(hf.errors.ActorRestarting):
            await ref.ask(Add(100), restarting="fail")
        with pytest.raises(hf.errors.AskTimeout, match="it was not handled"):
            await ref.ask(Add(100), 0.05)
        with pytest.raises(hf.errors.AlreadyStarted) as there:
            await guests.ask(hf.StartChild(guest(kind, why, file)))
        there.value.ref.tell(Add(1000))
        assert not asked.done()
        await let_come(system, why, file)
        assert await asked == (16 if kind in RECORDED else 11)
        assert await ref.ask(Add(0)) == (1016 if kind in RECORDED else 1011)


@pytest.mark.parametrize("kind", KINDS)
async def test_when_their_supervisor_is_restarted(kind: str, file: str) -> None:
    async with program(None) as system:
        guests = await system.start(hf.dynamic("guests", journal=True))
        await add(system, kind, "bound", file)
        before = system.ref(PATH, Guest)
        await system.ref("/app", hf.Supervisor).ask(hf.TerminateChild("desk"))
        with system.events() as events:
            guests.kill()
            while (await events.until(hf.events.ActorStarted)).address != "/app/guests":
                pass
        asked = [system.ref(PATH, Guest).ask(Add(1), 30.0), before.ask(Add(10), 30.0)]
        speaker = system.ref("/app/speaker", Speaker)
        asked.append(speaker.ask(Add(100), 30.0))
        guests.kill()  # Once more: what a recorded one was told waits on, and whoever has asked may ask again.
        done = asyncio.gather(*asked, return_exceptions=True)
        await system.ref("/app", hf.Supervisor).ask(hf.RestartChild("desk"))
        first, second, third = await done
        if kind in RECORDED:
            assert isinstance(first, hf.errors.ActorStopped)
            assert isinstance(second, hf.errors.ActorStopped)
            assert third == 105
        while True:
            try:
                assert await system.ref(PATH, Guest).ask(Add(0), 30.0) in (105, 100, 0)
                break
            except (hf.errors.NoSuchActor, hf.errors.ActorStopped):
                await asyncio.sleep(0.01)


@pytest.mark.parametrize("end", ["stop", "kill"])
@pytest.mark.parametrize("by", ["nobody", "tell", "ask"])
@pytest.mark.some(3)
async def test_what_they_are_told_meanwhile_is_kept(by: str, end: str, tmp_path: Path, file: str) -> None:
    store = f"sqlite:{tmp_path}/store"
    async with program(store) as system:
        await system.start(hf.dynamic("guests", journal=True))
        await add(system, "recorded", "bound", file)
    player = str(Path(__file__).with_name("expected_player.py"))
    assert await ended(player, store, by, end) == (-signal.SIGKILL if end == "kill" else 0)
    async with program(store) as system:
        await come(system)
        await let_come(system, "bound", file)
        async with asyncio.timeout(30.0):
            while await system.ref(PATH, Guest).ask(Add(0)) == 5:
                await asyncio.sleep(0.01)
        assert await system.ref(PATH, Guest).ask(Add(0)) == 15


@pytest.mark.parametrize("verb", [Tell, Add])
def test_what_a_recorded_actor_says_to_them_is_said_once(verb: type[Tell | Add]) -> None:
    """The root is killed at any moment of that: the speaker's turn and what it has said are one append."""
    kept = hf.hybrid()
    desk = hf.child("desk", hf.start(Desk))
    speaker = hf.child("speaker", hf.start(Speaker), recovery=kept)
    waiting = hf.child("guest", hf.start(Guest), recovery=kept, bindings={"desk": "/app/desk"})
    guests = hf.dynamic("guests", journal=True, intensity=100)

    @simulate(seeds=40, store="simulated")
    async def run(system: GuardedSystem, simulation: Simulation) -> None:
        await system.start(desk)
        await (await system.start(guests)).ask(hf.StartChild(waiting))
        assert await system.ref(PATH, Guest).ask(Add(5)) == 5
        system = await simulation.crash_root()
        await system.start(guests)
        said = await system.start(speaker)
        for _ in range(3):
            await said.send(verb(10))
        await simulation.moment(12)
        system = await simulation.crash_root()
        await system.start(guests)
        await system.start(speaker)
        await system.start(desk)
        await advance(60.0)
        assert await system.ref(PATH, Guest).ask(Add(0)) == 35

    run()


async def test_who_is_stopped_meanwhile_is_not_there_any_more(tmp_path: Path, file: str) -> None:
    async with program(f"sqlite:{tmp_path}/store") as system:
        await system.start(hf.dynamic("guests", journal=True))
        await add(system, "recorded", "bound", file)
    async with program(f"sqlite:{tmp_path}/store") as system:
        guests = await come(system)
        asked = system.ref(PATH, Guest).ask(Add(1), 30.0)
        await guests.ask(hf.TerminateChild("guest"))
        with pytest.raises(hf.errors.ActorStopped):
            await asked
        with pytest.raises(hf.errors.NoSuchActor):
            system.ref(PATH, Guest)


async def test_a_child_waits_for_another_one_that_comes(tmp_path: Path, file: str) -> None:
    """Its address alone does not do: what it would ask at its start would not be answered."""
    store = f"sqlite:{tmp_path}/store"
    late = hf.child("late", hf.start(Guest), bindings={"desk": PATH})
    async with program(store) as system:
        guests = await system.start(hf.dynamic("guests", journal=True))
        await add(system, "recorded", "bound", file)
        await guests.ask(hf.StartChild(late))
    async with program(store) as system:
        counts = await (await come(system)).ask(hf.supervision.CountChildren())
        assert counts.awaited == {"/app/desk": 1, PATH: 1}
        assert counts.active == 0
        asked = system.ref("/app/guests/late", Guest).ask(Add(3), 30.0)
        await let_come(system, "bound", file)
        assert await asked == 3


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_service_is_not_ready_while_they_wait(isolation: str, tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path}/store"
    one = hf.child(None, hf.start(Guest), bindings={"desk": "/app/house/desk"}, recovery=hf.hybrid())

    def house(*, has_desk: bool) -> hf.ChildSpec[hf.Actor]:
        desk = hf.child("desk", hf.start(Desk), autostart=has_desk)
        guests = hf.dynamic("guests", template=one, journal=True)
        children = [desk, guests] if has_desk else [guests, desk]
        return hf.supervisor("house", children=children, isolation=isolation)  # type: ignore[arg-type]

    async with hf.ActorSystem("app", store=store, log=False) as system:
        await system.start(house(has_desk=True))
        for _ in range(3):
            await system.ref("/app/house/guests", hf.supervision.DynamicSupervisor).ask(hf.StartChild())
    async with Service(hf.ActorSystem("app", store=store, log=False)) as service:
        await service.system.start(house(has_desk=False))
        service.up()
        for _ in range(2):
            ready = await service.ready()
            assert ready.text == "3 of 3 children of /app/house/guests wait for /app/house/desk"
            assert ready.status == 503
        assert (await service.live()).is_good
        await service.system.ref("/app/house", hf.Supervisor).ask(hf.RestartChild("desk"))
        async with asyncio.timeout(20.0):
            while not (await service.ready()).is_good:
                await asyncio.sleep(0.01)


async def test_in_a_process_a_start_that_is_asked_for_again_waits_for_its_turn(tmp_path: Path) -> None:
    begun, goes_on = tmp_path / "begun", tmp_path / "begun.goes_on"
    guests = hf.dynamic("guests", journal=True, template=hf.child(None, hf.start(Slow)))  # type: ignore[call-arg]
    starter = hf.child("starter", hf.start(Starter, str(begun)))
    goes_on.touch()
    async with hf.ActorSystem("app", log=False) as system:
        house = hf.supervisor("house", children=[starter, guests], isolation="process")
        ref = await system.start(house)
        for name in ("a", "b"):
            with contextlib.suppress(hf.errors.AlreadyStarted):
                order = hf.StartChild(id=name, args=(str(goes_on),))
                await system.ref("/app/house/guests", hf.supervision.DynamicSupervisor).ask(order)
        async with asyncio.timeout(30.0):
            while not begun.exists():
                await asyncio.sleep(0.01)
        begun.unlink()
        goes_on.unlink()
        ref.kill()
        async with asyncio.timeout(30.0):
            while not begun.exists():  # It has asked: "a" is being started, and "b" has to wait for that.
                await asyncio.sleep(0.01)
            goes_on.touch()
            while not (said := await answer(system)):
                await asyncio.sleep(0.01)
        assert said == "7"


async def answer(system: hf.ActorSystem) -> str:
    try:
        return await system.ref("/app/house/starter", Starter).ask(Look(), 30.0)
    except (hf.errors.NoSuchActor, hf.errors.ActorStopped):
        return ""
