"""An actor with a process of its own is moved to a supervisor in another process, and away from one."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import os
import random
import signal
import time
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest

import holdfast as hf
from holdfast.actors.kernel.message import message_name
from holdfast.actors.process.wire import frames
from holdfast.supervision.admin import RemoveChild
from tests.actors.process.waiting import next_event
from tests.launched import kills_itself
from tests.migration.far_places import IN_TIME, PLACES, Pump, pid_of, processes, traveller
from tests.migration.travellers import KINDS, Add, Luggage, Seen, Stream, Traveller
from tests.system.test_transaction_commit import Die
from tests.system.trees import Stumble

pytestmark = pytest.mark.usefixtures("warm_programs")

WAYS = {"far to near": ("far", "near"), "near to far": ("near", "far"), "far to far": ("far", "other")}


def supervisors(kind: str, at: str, isolation: Any) -> list[hf.ChildSpec]:
    """`/app/near` in the root's process, `/app/far` and `/app/other` in processes; `one` is below `at`."""
    isolations: dict[str, Any] = {"near": "task", "far": "process", "other": "process"}
    return [
        hf.supervisor(
            name, children=[traveller(kind, isolation)] if name == at else [], isolation=place, intensity=1000
        )
        for name, place in isolations.items()
    ]


async def move(system: hf.ActorSystem, ref: Any, to: str, *then: hf.system.Operation) -> None:
    async with system.transaction(timeout=IN_TIME) as change:
        change.move(ref, f"/app/{to}")
        for step in then:
            change.step(step)


@pytest.fixture
async def system() -> Any:
    async with hf.ActorSystem("app", log=False, intensity=1000) as running:
        yield running


@pytest.mark.pairs
@pytest.mark.parametrize("way", list(WAYS))
@pytest.mark.parametrize("kind", list(KINDS))
@pytest.mark.parametrize("isolation", PLACES)
async def test_it_goes_with_all_it_has(system: hf.ActorSystem, isolation: str, kind: str, way: str) -> None:
    old, new = WAYS[way]
    for spec in supervisors(kind, old, isolation):
        await system.start(spec)
    ref = system.ref(f"/app/{old}/one", Traveller)
    luggage, stream = Luggage(system, ref), Stream(ref)
    await luggage.pack()
    await stream.reached(20)
    own = processes(system, ref)
    for to in (new, old, new):
        await move(system, ref, to)
        assert ref.path == f"/app/{to}/one"
        assert processes(system, ref) == ([pid_of(system, to)] if isolation == "task" else own)
        await stream.reached(20)
    await stream.stop()
    seen = await luggage.unpack()
    stream.judge(seen["added"])
    for name in ("near", "far", "other"):
        below = await system.ref(f"/app/{name}", hf.Supervisor).ask(hf.WhichChildren(), IN_TIME)
        assert [(one.id, one.state) for one in below] == ([("one", "running")] if name == new else [])


async def is_at_one_place(system: hf.ActorSystem, ref: Any) -> None:
    """Its address, and what the supervisors say in the end, agree."""
    async with asyncio.timeout(IN_TIME):
        while True:
            told = [
                f"/app/{name}/{one.id}"
                for name in ("near", "far", "other")
                for one in await system.ref(f"/app/{name}", hf.Supervisor).ask(hf.WhichChildren(), IN_TIME)
                if one.state == "running"
            ]
            if told == [ref.path]:
                return


@pytest.mark.pairs
@pytest.mark.parametrize("way", list(WAYS))
@pytest.mark.parametrize("isolation", PLACES)
@pytest.mark.parametrize("victim", ["old", "new", "own"])
@pytest.mark.parametrize("seed", range(6))
async def test_a_process_that_is_killed_at_any_instant_loses_nothing(
    system: hf.ActorSystem, seed: int, victim: str, isolation: str, way: str
) -> None:
    old, new = WAYS[way]
    for spec in supervisors("recorded", old, isolation):
        await system.start(spec)
    ref = system.ref(f"/app/{old}/one", Traveller)
    pump = Pump(ref)
    await pump.reached(10)
    moving = asyncio.ensure_future(move(system, ref, new))
    rng = random.Random(seed)
    struck = system._node.loop.time() + rng.random() * 0.3
    while not moving.done() and system._node.loop.time() < struck:
        await asyncio.sleep(0)
    with contextlib.suppress(hf.errors.NoSuchActor, ProcessLookupError):  # It lives nowhere just now.
        pid = (
            rng.choice(processes(system, ref)) if victim == "own" else pid_of(system, {"old": old, "new": new}[victim])
        )
        if pid != os.getpid():
            os.kill(pid, signal.SIGKILL)
    try:
        await moving
    except (hf.TransactionFailed, hf.TransactionRefused):
        await pump.reached(5)
        await move(system, ref, new)
    await pump.reached(10)
    await pump.judge()
    assert ref.path == f"/app/{new}/one"
    await is_at_one_place(system, ref)


@asynccontextmanager
async def program(store: str, old: str, isolation: str) -> AsyncGenerator[hf.ActorSystem]:
    async with hf.ActorSystem("app", store=f"sqlite:{store}", durability="os", log=False, intensity=99) as system:
        for spec in supervisors("recorded", old, isolation):
            await system.start(spec)
        yield system


async def killed(store: str, when: str, old: str, new: str, isolation: str) -> None:
    """The root is killed by a step in the middle of the move."""
    async with program(store, old, isolation) as system:
        ref = system.ref(f"/app/{old}/one", Traveller)
        await ref.ask(Add(7))
        async with system.transaction(timeout=IN_TIME) as change:
            if when == "finish":
                change.step(Die(when))
            change.move(ref, f"/app/{new}")
            change.step(Die("finish" if when == "settled" else when))


PROGRAM = """
import asyncio, sys
from tests.migration.test_far_moves import killed


if __name__ == "__main__":
    asyncio.run(killed(*sys.argv[1:]))
"""


@pytest.mark.pairs
@pytest.mark.parametrize("way", list(WAYS))
@pytest.mark.parametrize("isolation", PLACES)
@pytest.mark.parametrize("when", ["prepare", "commit", "finish", "settled"])
async def test_a_root_that_is_killed_has_it_at_one_of_the_two(
    tmp_path: Path, when: str, isolation: str, way: str
) -> None:
    (tmp_path / "program.py").write_text(PROGRAM)
    old, new = WAYS[way]
    await kills_itself(tmp_path / "program.py", tmp_path / "store", when, old, new, isolation, timeout=IN_TIME)
    async with program(str(tmp_path / "store"), old, isolation) as system:
        at = new if when in ("finish", "settled") else old
        ref = system.ref(f"/app/{at}/one", Traveller)
        assert await ref.ask(Add(1), IN_TIME) == 8
        await is_at_one_place(system, ref)
        assert (processes(system, ref) == [pid_of(system, at)]) == (isolation == "task")
        if at != old:  # Who knows only the address of before reaches it.
            assert await system.ref(f"/app/{old}/one", Traveller).ask(Add(1), IN_TIME) == 9


class Hold(hf.Message[str]):
    """Keep the whole process busy while a file is there; then do to `one` all that may be done to a neighbour.

    The reply is how its supervisor has answered the order.
    """

    file: str
    order: str
    path: str


class Watch(hf.Message[bool]): ...


class Ended(hf.Message[list[str]]): ...


class Reach(hf.Message[dict[str, Any]]):
    path: str


class Holder(hf.Actor):
    """Lives with the old supervisor."""

    def __init__(self) -> None:
        self.downs: list[str] = []

    @hf.on(Watch)
    def watch(self, message: Watch) -> bool:
        self.ctx.monitor(self.ctx.find("/app/far/one", Traveller))
        return True

    @hf.on(Hold)
    async def hold(self, message: Hold) -> str:
        Path(message.file).touch()
        while Path(message.file).exists():
            time.sleep(0.001)
        one = self.ctx.find(message.path, Traveller)
        one.tell(Add(5))
        self.ctx.monitor(one)
        order = {"terminate": hf.TerminateChild("one"), "remove": RemoveChild("one", erase=True)}.get(message.order)
        try:
            await self.ctx.find("/app/far", hf.Supervisor).ask(order or hf.RestartChild("inner", running=True), IN_TIME)
        except hf.Refusal as no:
            return type(no).__name__
        return "done"

    @hf.on(Reach)
    async def reach(self, message: Reach) -> dict[str, Any]:
        return await self.ctx.find(message.path, Traveller).ask(Seen(), IN_TIME)

    @hf.on(Ended, readonly=True)
    def ended(self, message: Ended) -> list[str]:
        return self.downs

    def on_down(self, source: hf.ActorRef[Any], reason: hf.ExitReason, recovering: bool) -> None:
        self.downs.append(source.path)


async def held(system: hf.ActorSystem, file: Path, then: Any, order: str = "terminate") -> str:
    """Move `one` out of a process that is busy, do something, and let that process go on."""
    holder, one = system.ref("/app/far/holder", Holder), system.ref("/app/far/one", Traveller)
    asked: list[Any] = []

    async def hold(system: hf.ActorSystem) -> None:
        asked.append(holder.ask(Hold(str(file), order, one.path), IN_TIME))
        while not file.exists():
            await asyncio.sleep(0.005)

    async with system.transaction(timeout=IN_TIME) as change:
        change.move(one, "/app/near")
        change.step(Stumble(hold))
    await then()
    file.unlink()
    return str(await asked[0])


@pytest.fixture
async def busy(system: hf.ActorSystem) -> hf.ActorSystem:
    near, far, _ = supervisors("plain", "far", "process")
    await system.start(near)
    children = (*far.start.args[1], hf.child("holder", hf.start(Holder)))
    await system.start(hf.supervisor("far", children=children, isolation="process", intensity=1000))
    return system


@pytest.mark.parametrize("order", ["terminate", "remove"])
async def test_what_its_old_supervisor_says_before_it_has_heard_is_void(
    busy: hf.ActorSystem, tmp_path: Path, order: str
) -> None:
    one = busy.ref("/app/far/one", Traveller)
    own = busy.pid_of(one)
    with busy.events() as events:

        async def nothing() -> None: ...

        assert await held(busy, tmp_path / "held", nothing, order) == "NoSuchChild"
        assert (await one.ask(Seen(), IN_TIME))["added"] == [5]
        holder = busy.ref("/app/far/holder", Holder)
        assert (await holder.ask(Reach("/app/far/one"), IN_TIME))["added"] == [5]
        assert not [event for event in events.take() if isinstance(event, hf.events.TrustBreached)]
    assert (one.path, busy.pid_of(one)) == ("/app/near/one", own)
    assert [info.id for info in await busy.ref("/app/far", hf.Supervisor).ask(hf.WhichChildren())] == ["holder"]
    await busy.stop(one)
    async with asyncio.timeout(IN_TIME):
        while not await holder.ask(Ended(), IN_TIME):
            await asyncio.sleep(0.005)
    assert await holder.ask(Ended(), IN_TIME) == ["/app/near/one"]


async def test_an_end_that_its_old_supervisor_process_has_not_heard_of_is_told_there(
    busy: hf.ActorSystem, tmp_path: Path
) -> None:
    holder, one = busy.ref("/app/far/holder", Holder), busy.ref("/app/far/one", Traveller)
    assert await holder.ask(Watch())

    async def restarted() -> None:
        own = busy.pid_of(one)
        os.kill(own, signal.SIGKILL)
        assert (await one.ask(Seen(), IN_TIME))["added"] == []

    await held(busy, tmp_path / "held", restarted)
    async with asyncio.timeout(IN_TIME):
        while not await holder.ask(Ended(), IN_TIME):
            await asyncio.sleep(0.005)


@pytest.mark.parametrize("isolation", PLACES)
async def test_a_supervisor_within_a_process_comes_back_with_who_has_come_and_without_who_has_left(
    system: hf.ActorSystem, isolation: str
) -> None:
    inner = [
        hf.supervisor(name, children=[traveller("recorded", isolation)] if name == "left" else [], intensity=9)
        for name in ("left", "right")
    ]
    await system.start(hf.supervisor("far", children=inner, isolation="process", intensity=99))
    one = system.ref("/app/far/left/one", Traveller)
    assert await one.ask(Add(1)) == 1
    async with system.transaction(timeout=IN_TIME) as change:
        change.move(one, "/app/far/right")
    process = pid_of(system, "far")
    for name, below in (("left", []), ("right", ["one"])):
        top = system.ref("/app/far", hf.Supervisor)
        await top.ask(hf.RestartChild(name, running=True), IN_TIME)
        async with asyncio.timeout(IN_TIME):
            while True:
                await asyncio.sleep(0.005)
                with contextlib.suppress(hf.errors.NoSuchActor, hf.ActorStopped, hf.AskFailed):
                    told = await system.ref(f"/app/far/{name}", hf.Supervisor).ask(hf.WhichChildren(), IN_TIME)
                    if [info.id for info in told] == below:
                        break
    assert pid_of(system, "far") == process
    assert await system.ref("/app/far/right/one", Traveller).ask(Add(1), IN_TIME) == 2
    assert await system.ref("/app/far/left/one", Traveller).ask(Add(1), IN_TIME) == 3


async def test_a_process_that_is_started_anew_knows_where_they_are_who_have_left(busy: hf.ActorSystem) -> None:
    one = busy.ref("/app/far/one", Traveller)
    assert await one.ask(Add(4)) == 4
    await move(busy, one, "near")
    os.kill(pid_of(busy, "far"), signal.SIGKILL)
    seen: dict[str, Any] = {}
    async with asyncio.timeout(IN_TIME):
        while not seen:
            await asyncio.sleep(0.005)
            with contextlib.suppress(hf.errors.NoSuchActor, hf.ActorStopped, hf.AskFailed):
                seen = await busy.ref("/app/far/holder", Holder).ask(Reach("/app/far/one"), IN_TIME)
    assert seen["added"] == [4]


async def test_who_comes_to_the_address_that_was_left_is_reached_there(busy: hf.ActorSystem) -> None:
    """Though the process has named that address before."""
    holder, one = busy.ref("/app/far/holder", Holder), busy.ref("/app/far/one", Traveller)
    assert await one.ask(Add(4)) == 4
    assert (await holder.ask(Reach("/app/far/one"), IN_TIME))["added"] == [4]
    await move(busy, one, "near")
    async with busy.transaction(timeout=IN_TIME) as change:
        change.add("/app/far", traveller("plain", "process"))
    assert (await holder.ask(Reach("/app/far/one"), IN_TIME))["added"] == []
    assert (await holder.ask(Reach("/app/near/one"), IN_TIME))["added"] == [4]


@pytest.mark.parametrize("way", list(WAYS))
@pytest.mark.parametrize("isolation", PLACES)
async def test_a_move_that_is_given_up_leaves_it_where_it_was(system: hf.ActorSystem, isolation: str, way: str) -> None:
    old, new = WAYS[way]
    for spec in supervisors("plain", old, isolation):
        await system.start(spec)
    ref = system.ref(f"/app/{old}/one", Traveller)
    pump = Pump(ref)
    await pump.reached(5)
    own, tree = processes(system, ref), system.tree()
    for _ in range(2):
        with pytest.raises(hf.TransactionFailed, match="there was a stone") as failed:
            await move(system, ref, new, Stumble())
        assert failed.value.kept == ()
        await pump.reached(5)
        assert (ref.path, processes(system, ref), system.tree()) == (f"/app/{old}/one", own, tree)
        await is_at_one_place(system, ref)
    await move(system, ref, new)
    await pump.judge()


async def test_what_cannot_be_is_refused_before_anything_is_done(system: hf.ActorSystem) -> None:
    far = [
        traveller("plain", "task"),
        hf.dynamic("pool"),
        hf.child("stopped", hf.start(Traveller), autostart=False),
    ]
    await system.start(hf.supervisor("near", children=[hf.child("two", hf.start(Traveller), autostart=False)]))
    await system.start(hf.supervisor("far", children=far, isolation="process"))
    pooled = await system.ref("/app/far/pool", hf.Supervisor).ask(
        hf.StartChild(hf.child("pooled", hf.start(Traveller))), IN_TIME
    )
    refusals: dict[str, Any] = {
        "it does not run": lambda change: change.move("/app/near/two", "/app/far"),
    }
    for why, step in refusals.items():
        with pytest.raises(hf.TransactionRefused, match=why):
            async with system.transaction(timeout=IN_TIME) as change:
                step(change)
    async with system.transaction(timeout=IN_TIME) as change:
        change.move(pooled.path, "/app/near")  # Only its supervisor, in its process, has its spec.
    assert (await pooled.ask(Seen(), IN_TIME))["added"] == []

    def both(change: Any) -> None:
        change.move("/app/far/one", "/app/near")
        change.suspend("/app/near/one")

    for dry_run in (True, False):
        with pytest.raises(hf.TransactionRefused, match="in a transaction of its own"):
            async with system.transaction(timeout=IN_TIME, dry_run=dry_run) as change:
                both(change)


class Slow(hf.Actor):
    """Its end waits until a file is gone."""

    def __init__(self, file: str) -> None:
        self.file = file

    async def on_stop(self, reason: hf.ExitReason) -> None:
        while Path(self.file).exists():
            Path(f"{self.file}.met").touch()
            await asyncio.sleep(0.005)


class Last(hf.Actor):
    """Its end leaves a file."""

    def __init__(self, file: str) -> None:
        self.file = file

    def on_stop(self, reason: hf.ExitReason) -> None:
        Path(self.file).touch()


@pytest.fixture
def slow(tmp_path: Path) -> Any:
    file = tmp_path / "slow"
    file.touch()
    yield file
    file.unlink(missing_ok=True)


@pytest.mark.parametrize("first", ["one", "slow"])
async def test_a_supervisor_that_stops_loses_its_child_and_lets_it_live(
    system: hf.ActorSystem, slow: Path, tmp_path: Path, first: str
) -> None:
    """It stops one behind the other; this one, which it has told to stop, or is about to, has another supervisor."""
    children = [traveller("plain", "process"), hf.child("slow", hf.start(Slow, str(slow)), shutdown="infinity")]
    last = hf.child("last", hf.start(Last, str(tmp_path / "last")))
    children = [last, *(children if first == "slow" else children[::-1])]
    inner = hf.supervisor("inner", children=children, intensity=9)
    await system.start(hf.supervisor("near"))
    team = [inner, hf.child("holder", hf.start(Holder))]
    await system.start(hf.supervisor("far", children=team, isolation="process", intensity=99))
    one, holder = system.ref("/app/far/inner/one", Traveller), system.ref("/app/far/holder", Holder)
    own, file, asked = system.pid_of(one), tmp_path / "held", list[Any]()

    async def hold(system: hf.ActorSystem) -> None:
        asked.append(holder.ask(Hold(str(file), "restart", one.path), IN_TIME))
        while not file.exists():
            await asyncio.sleep(0.005)

    await move(system, one, "near", Stumble(hold))
    file.unlink()
    async with asyncio.timeout(IN_TIME):
        while (await one.ask(Seen(), IN_TIME))["added"] != [5]:
            await asyncio.sleep(0.005)
    slow.unlink()
    assert await asked[0] == "done"
    assert (tmp_path / "last").exists()
    assert (await holder.ask(Reach("/app/far/inner/one"), IN_TIME))["added"] == [5]
    assert (one.path, system.pid_of(one)) == ("/app/near/one", own)


class Speak(hf.Message[int]):
    """Tell that actor something; the reply is the number under which the root knows who tells it."""

    to: str


class Forge(hf.Message[bool]):
    """Tell that actor something in the name of another one."""

    to: str
    sender: int


class Speaker(hf.Actor):
    @hf.on(Speak)
    def speak(self, message: Speak) -> int:
        names = self.ctx._cell.node.ports.uplink.connection.names
        self.ctx.find(message.to, Traveller).tell(Add(1))
        return int(names.to_wire(self.ctx.path))

    @hf.on(Forge)
    def forge(self, message: Forge) -> bool:
        connection = self.ctx._cell.node.ports.uplink.connection
        name, to = connection.names.to_wire(message_name(Add)), connection.names.to_wire(message.to)
        connection.send(frames.Tell(to, name, msgspec.Raw(msgspec.msgpack.encode([1])), 0, message.sender))
        return True


async def test_a_process_does_not_speak_for_an_actor_that_has_left_it(system: hf.ActorSystem) -> None:
    team = [hf.child(name, hf.start(Speaker)) for name in ("one", "evil")]
    await system.start(hf.supervisor("near"))
    await system.start(hf.supervisor("far", children=team, isolation="process", intensity=99))
    other = await system.start(hf.child("other", hf.start(Traveller)))
    one, evil = (system.ref(f"/app/far/{name}", Speaker) for name in ("one", "evil"))
    senders = [await each.ask(Speak(other.path), IN_TIME) for each in (evil, one)]
    for sender in senders:
        await evil.ask(Forge(other.path, sender), IN_TIME)  # Both are of its own process.
    assert len((await other.ask(Seen(), IN_TIME))["added"]) == 4
    await move(system, one, "near")
    with system.events() as events:
        evil.tell(Forge(other.path, senders[-1]))
        breach = await next_event(events, hf.events.TrustBreached)
    assert breach.address == "/app/far"
    assert len((await other.ask(Seen(), IN_TIME))["added"]) == 4


class Reluctant(Traveller):
    """Does not begin while there is a file."""

    def __init__(self, file: str = "") -> None:
        super().__init__()
        self.file = file

    async def on_start(self, restored: bool) -> None:
        while Path(self.file).exists():
            Path(f"{self.file}.met").touch()
            await asyncio.sleep(0.005)


@pytest.mark.parametrize("way", list(WAYS))
@pytest.mark.parametrize("kind", list(KINDS))
async def test_the_time_limit_holds_for_the_process_that_it_is_lent(
    system: hf.ActorSystem, kind: str, way: str, tmp_path: Path
) -> None:
    """What does not begin there is given up with the transaction, and the life goes on as it was."""
    old, new = WAYS[way]
    one = dataclasses.replace(traveller(kind, "task"), start=hf.start(Reluctant, str(tmp_path / "no")))
    for name in {old, new}:
        place: Any = "task" if name == "near" else "process"
        await system.start(hf.supervisor(name, children=[one] if name == old else [], isolation=place))
    ref = system.ref(f"/app/{old}/one", Reluctant)
    assert await ref.ask(Add(1), timeout=IN_TIME) == 1
    (tmp_path / "no").touch()
    with pytest.raises(hf.TransactionFailed, match=r"not within 0\.5 s") as failed:
        async with asyncio.timeout(IN_TIME), system.transaction(timeout=0.5) as change:
            change.move(ref, f"/app/{new}")
    assert failed.value.kept == ()
    assert (await ref.ask(Add(1), timeout=5.0), ref.path) == (2, f"/app/{old}/one")


@pytest.mark.parametrize("kind", ["plain", "checkpoint_only"])  # Another one rests for the transaction, in its turn.
@pytest.mark.parametrize("new", ["near", "other"])
async def test_who_is_on_its_way_to_live_elsewhere_is_not_given_away_meanwhile(
    system: hf.ActorSystem, new: str, kind: str, tmp_path: Path
) -> None:
    """Its old supervisor's process would speak of an actor that has left it, and be ended for that."""
    one = dataclasses.replace(traveller(kind, "process"), start=hf.start(Reluctant, str(tmp_path / "no")))
    for name in {"far", new}:
        place: Any = "task" if name == "near" else "process"
        await system.start(hf.supervisor(name, children=[one] if name == "far" else [], isolation=place))
    ref, far = system.ref("/app/far/one", Reluctant), pid_of(system, "far")
    assert await ref.ask(Add(1), timeout=IN_TIME) == 1
    (tmp_path / "no").touch()
    moved = asyncio.ensure_future(system.set_isolation(ref, "task", timeout=IN_TIME))
    async with asyncio.timeout(IN_TIME):
        while not (tmp_path / "no.met").exists():
            await asyncio.sleep(0.005)
    with pytest.raises(hf.TransactionFailed):
        async with system.transaction(timeout=0.5) as change:
            change.move(ref, f"/app/{new}")
    (tmp_path / "no").unlink()
    await moved
    assert (await ref.ask(Add(1), timeout=IN_TIME), system.pid_of(ref)) == (2, far)
    await move(system, ref, new)
    assert (await ref.ask(Add(1), timeout=IN_TIME), pid_of(system, "far")) == (3, far)


@pytest.mark.parametrize("kind", ["plain", "checkpoint_only"])
@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_who_is_on_its_way_to_live_elsewhere_keeps_its_address_meanwhile(
    system: hf.ActorSystem, isolation: Any, kind: str, tmp_path: Path
) -> None:
    """The process in which it begins would be spoken to under an address that it does not know."""
    one = dataclasses.replace(traveller(kind, isolation), start=hf.start(Reluctant, str(tmp_path / "no")))
    await system.start(hf.supervisor("near", children=[one]))
    await system.start(hf.supervisor("elsewhere"))
    ref = system.ref("/app/near/one", Reluctant)
    assert await ref.ask(Add(1), timeout=IN_TIME) == 1
    (tmp_path / "no").touch()
    to: Any = "task" if isolation == "process" else "process"
    moved = asyncio.ensure_future(system.set_isolation(ref, to, timeout=IN_TIME))
    async with asyncio.timeout(IN_TIME):
        while not (tmp_path / "no.met").exists():
            await asyncio.sleep(0.005)
    with pytest.raises(hf.TransactionFailed, match="is on its way to live elsewhere"):
        async with system.transaction(timeout=0.5) as change:
            change.move(ref, "/app/elsewhere")
    (tmp_path / "no").unlink()
    await moved
    assert await ref.ask(Add(1), timeout=IN_TIME) == 2
    await move(system, ref, "elsewhere")
    assert await ref.ask(Add(1), timeout=IN_TIME) == 3
