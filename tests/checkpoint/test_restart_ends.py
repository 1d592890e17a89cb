"""A recorded actor that ends by `ctx.stop` in a turn ends once, also if the root dies right behind that turn."""

from __future__ import annotations

import asyncio
from typing import Any, Literal

import pytest

import holdfast as hf
from holdfast.actors.exit_reasons import Crash, Shutdown
from holdfast.testing import GuardedSystem, Simulation, advance, simulate

SEEDS = 3
METHODS: dict[str, Any] = {"hybrid": hf.hybrid, "replay_only": hf.replay_only, "checkpoint_only": hf.checkpoint_only}


class End(hf.Message):
    how: str = "normal"


class Ended(hf.Message): ...


class Heard(hf.Message[int]): ...


class Alive(hf.Message[int]): ...


class Listener(hf.Actor):
    """Hears of ends; `heard` tells the test, too."""

    heard = asyncio.Event()

    def __init__(self) -> None:
        self.count = 0

    @hf.on(Ended)
    def ended(self, message: Ended) -> None:
        self.count += 1
        Listener.heard.set()

    @hf.on(Heard, readonly=True)
    def read(self, message: Heard) -> int:
        return self.count


class Guest(hf.Actor):
    """Leaves when it is told to, and lets it. `farewells` are the reasons that its `on_stop` was called with."""

    listener: hf.Binding[Listener]
    farewells: list[str] = []  # noqa: RUF012  # of all lives, for the test
    may_leave = asyncio.Event()

    def __init__(self) -> None:
        self.ends = 0

    @hf.on(End)
    def end(self, message: End) -> None:
        self.ends += 1
        self.listener.tell(Ended())
        match message.how:
            case "crash":
                self.ctx.stop(Crash("Tired", "of it"))
            case "shutdown":
                self.ctx.stop(Shutdown("late"))
            case _:
                self.ctx.stop()

    @hf.on(Alive)
    def alive(self, message: Alive) -> int:
        return self.ends

    async def on_stop(self, reason: hf.ExitReason) -> None:
        Guest.farewells.append(str(reason))
        await Guest.may_leave.wait()


def guests(restart: Any, method: str = "hybrid") -> hf.ChildSpec:
    recovery, bindings = METHODS[method](), {"listener": "/app/listener"}
    template = hf.child(None, hf.start(Guest), restart=restart, recovery=recovery, bindings=bindings)
    return hf.dynamic("guests", template=template, journal=True, intensity=5)


def house(restart: Any) -> hf.ChildSpec:
    bindings = {"listener": "/app/listener"}
    ann = hf.child("ann", hf.start(Guest), restart=restart, recovery=hf.hybrid(), bindings=bindings)
    return hf.supervisor("guests", children=[ann], intensity=5)


async def begun(system: hf.ActorSystem, top: hf.ChildSpec) -> hf.ActorRef[hf.Supervisor]:
    """The tree of each program."""
    await system.start(hf.child("listener", hf.start(Listener), recovery=hf.hybrid()))
    return await system.start(top)


async def ends_and_dies(
    system: hf.ActorSystem, simulation: Simulation, how: str = "normal", name: str = "ann"
) -> GuardedSystem:
    """Have a guest end, and the root die when others have heard of that, and before its supervisor has."""
    Listener.heard, Guest.may_leave, Guest.farewells = asyncio.Event(), asyncio.Event(), []
    system.ref(f"/app/guests/{name}", Guest).tell(End(how))
    await Listener.heard.wait()
    system = await simulation.crash_root()
    Guest.may_leave.set()
    return system


async def states(top: hf.ActorRef[hf.Supervisor]) -> list[str]:
    await advance(5.0)
    return [one.state for one in await top.ask(hf.WhichChildren(), timeout=20.0)]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("restart", ["permanent", "transient", "temporary"])
def test_a_child_that_has_ended_by_itself_has_ended_when_the_root_is_started_again(restart: str, method: str) -> None:
    @simulate(seeds=SEEDS, store="simulated")
    async def run(system: GuardedSystem, simulation: Simulation) -> None:
        top = await begun(system, guests(restart, method))
        await top.ask(hf.StartChild(id="ann"))
        system = await ends_and_dies(system, simulation)
        for _ in range(2):  # The third program finds what the second one has made of it.
            top = await begun(system, guests(restart, method))
            assert await states(top) == (["running"] if restart == "permanent" else [])
            assert await system.ref("/app/listener", Listener).ask(Heard()) == 1
            if restart == "permanent":
                assert await system.ref("/app/guests/ann", Guest).ask(Alive()) == 1
            system = await simulation.crash_root()

    run()


def test_it_says_good_bye_and_can_be_started_again_by_hand() -> None:
    @simulate(seeds=SEEDS, store="simulated")
    async def run(system: GuardedSystem, simulation: Simulation) -> None:
        top = await begun(system, guests("transient"))
        await top.ask(hf.StartChild(id="ann"))
        system = await ends_and_dies(system, simulation, "shutdown")
        top = await begun(system, guests("transient"))
        assert await states(top) == []
        assert Guest.farewells == ["shutdown (late)"] * 2  # Nobody knows of the first program's.
        ann = await top.ask(hf.StartChild(id="ann"))
        assert ann is not None
        assert await ann.ask(Alive()) == 1  # What was recorded is there, and the end is no part of it.
        await advance(5.0)
        assert await states(top) == ["running"]

    run()


def test_the_reason_is_kept_for_its_supervisor_to_decide() -> None:
    @simulate(seeds=SEEDS, store="simulated")
    async def run(system: GuardedSystem, simulation: Simulation) -> None:
        top = await begun(system, guests("transient"))
        await top.ask(hf.StartChild(id="ann"))
        system.expect_crashes()
        system = await ends_and_dies(system, simulation, "crash")
        system.expect_crashes()
        top = await begun(system, guests("transient"))
        assert await states(top) == ["running"]
        assert await system.ref("/app/guests/ann", Guest).ask(Alive()) == 1

    run()


@pytest.mark.parametrize("restart", ["permanent", "transient"])
def test_a_child_of_a_list_ends_once_and_begins_with_the_program_after_that(restart: str) -> None:
    @simulate(seeds=SEEDS, store="simulated")
    async def run(system: GuardedSystem, simulation: Simulation) -> None:
        await begun(system, house(restart))
        system = await ends_and_dies(system, simulation)
        top = await begun(system, house(restart))
        assert await states(top) == ["running" if restart == "permanent" else "stopped"]
        system = await simulation.crash_root()
        top = await begun(system, house(restart))
        assert await states(top) == ["running"]

    run()


def test_what_was_recorded_under_an_id_that_was_made_up_is_erased() -> None:
    @simulate(seeds=SEEDS, store="simulated")
    async def run(system: GuardedSystem, simulation: Simulation) -> None:
        top = await begun(system, guests("transient"))
        guest = await top.ask(hf.StartChild())
        assert guest is not None
        system = await ends_and_dies(system, simulation, name=guest.path.rpartition("/")[2])
        top = await begun(system, guests("transient"))
        assert await states(top) == []
        again = await top.ask(hf.StartChild())
        assert again is not None
        assert await again.ask(Alive()) == 0

    run()


def test_a_permanent_child_that_replays_all_its_turns_ends_once() -> None:
    @simulate(seeds=SEEDS, store="simulated")
    async def run(system: GuardedSystem, simulation: Simulation) -> None:
        top = await begun(system, guests("permanent", "replay_only"))
        ann = await top.ask(hf.StartChild(id="ann"))
        assert ann is not None
        Guest.may_leave = asyncio.Event()
        Guest.may_leave.set()
        ann.tell(End())
        assert await states(top) == ["running"]
        assert await ann.ask(Alive()) == 1
        ann.kill()
        assert await ann.ask(Alive(), timeout=20.0) == 1

    run()


class Cue(hf.Message): ...


class Part(hf.Message[str]):
    way: str


async def told() -> int:
    return 1


class Actor(hf.Actor):
    """Has something to wait for in a turn, tells, and ends itself."""

    listener: hf.Binding[Listener]

    @hf.on(Part)
    async def play(self, message: Part) -> str:
        await self.ctx.sleep(0.1)
        pending: set[asyncio.Future[Any]] = set()
        match message.way:
            case "a message that is there":
                await self.ctx.wait_for(Cue)
            case "one of two":
                ways: set[asyncio.Future[Any]] = {
                    asyncio.ensure_future(self.ctx.sleep(1e6)),
                    asyncio.ensure_future(self.ctx.effect(told, key="k")),
                }
                _, pending = await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            case "behind its end":
                self.ctx.stop()
                await self.ctx.sleep(5.0)
        self.listener.tell(Ended())
        self.ctx.stop()
        for one in pending:
            one.cancel()
        return "played"

    @hf.on(Cue)
    def cue(self, message: Cue) -> None: ...


def player(durability: Literal["memory", "os"]) -> hf.ChildSpec:
    recovery, bindings = hf.hybrid(durability=durability), {"listener": "/app/listener"}
    return hf.child("actor", hf.start(Actor), restart="transient", recovery=recovery, bindings=bindings)


@pytest.mark.parametrize("has_store", [True, False])
@pytest.mark.parametrize("way", ["a message that is there", "one of two", "behind its end"])
def test_a_turn_that_ends_its_actor_is_over_before(way: str, has_store: bool) -> None:
    @simulate(seeds=SEEDS, store="simulated" if has_store else None)
    async def run(system: GuardedSystem) -> None:
        listener = await system.start(hf.child("listener", hf.start(Listener), recovery=hf.hybrid()))
        actor = await system.start(player("memory"))
        asked = asyncio.ensure_future(actor.ask(Part(way), timeout=60.0))
        if way == "a message that is there":
            await actor.send(Cue())
        assert await asked == "played"
        assert await listener.ask(Heard()) == 1

    run()


def test_a_turn_that_has_ended_its_actor_and_rests_is_over_before_also_after_a_crash() -> None:
    @simulate(seeds=SEEDS, store="simulated")
    async def run(system: GuardedSystem, simulation: Simulation) -> None:
        await system.start(hf.child("listener", hf.start(Listener), recovery=hf.hybrid()))
        await (await system.start(player("os"))).send(Part("behind its end"))
        await advance(2.0)
        system = await simulation.crash_root()
        listener = await system.start(hf.child("listener", hf.start(Listener), recovery=hf.hybrid()))
        await system.start(player("os"))
        await advance(10.0)
        assert await listener.ask(Heard()) == 1

    run()
