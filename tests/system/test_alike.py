"""An actor may do the same whatever kind it is of: each public name of `ctx`, and of the handles that it gives."""

from __future__ import annotations

import asyncio
import inspect
import random
import uuid
from collections.abc import Awaitable, Callable, Iterable, Iterator
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.kernel.envelope import AskHandle
from holdfast.actors.kernel.links import LifeMonitor
from holdfast.actors.kernel.timers import LoopTimer
from holdfast.checkpoint.life.recorded_context import RecordedMonitor, RecordedReplyHandle, RecordedTimer

PLACES: dict[str, dict[str, Any]] = {
    "plain": {},
    "process": {"isolation": "process"},
    "recorded": {"recovery": hf.hybrid(interval=3600.0)},
    "replayed": {"recovery": hf.replay_only()},
    "saved": {"recovery": hf.checkpoint_only(3600.0, every=1)},
    "recorded in a process": {"recovery": hf.hybrid(interval=3600.0), "isolation": "process"},
    "protected": {"mechanism": hf.ftm.PBR()},
    "active": {"mechanism": hf.ftm.LFR()},
}
HANDLES: dict[type[Any], tuple[type[Any], ...]] = {
    hf.Timer: (LoopTimer, RecordedTimer),
    hf.ReplyHandle: (AskHandle, RecordedReplyHandle),
    hf.Monitor: (LifeMonitor, RecordedMonitor),
}


class Use(hf.Message[str]):
    name: str


class Nothing(hf.Message): ...


class Refused(hf.Refusal): ...


class Peer(hf.Actor):
    @hf.on(Use)
    def use(self, message: Use) -> str:
        return "forwarded"

    @hf.on(Nothing)
    def nothing(self, message: Nothing) -> None:
        return None


class User(hf.Actor):
    peer: hf.Binding[Peer]

    def __init__(self) -> None:
        self.kept: list[Any] = []

    @hf.on(Use)
    async def use(self, message: Use) -> Any:
        used = USES[message.name](self)
        reply = await used if inspect.isawaitable(used) else used
        return "done" if reply is None else reply

    @hf.on(Nothing)
    def nothing(self, message: Nothing) -> None:
        return None


def timer(user: User, made: hf.Timer) -> str:
    user.kept.append(made)
    said = [isinstance(made, hf.Timer), made.is_active]
    made.cancel()
    return str([*said, made.is_active])


def monitor(user: User, made: hf.Monitor) -> str:
    user.kept.append(made)
    made.cancel()
    return str(isinstance(made, hf.Monitor))


def handle(user: User) -> Any:
    made = user.ctx.reply_handle()
    user.kept.append(made)
    assert isinstance(made, hf.ReplyHandle)
    if len(user.kept) % 2:
        made.reply("later")
    else:
        made.fail(Refused())
    return made


def trap(user: User) -> str:
    user.ctx.trap_exits = True
    return str(user.ctx.trap_exits)


async def waits(work: Awaitable[Any]) -> str:
    return str(await work)


async def publishes(user: User) -> str:
    await user.ctx.publish("/nothing", Nothing())
    return "published"


async def in_background(user: User) -> str:
    made = user.ctx.create_task(asyncio.sleep(0, "done"))
    return f"{isinstance(made, asyncio.Task)} {await made}"


def forwards(user: User) -> str:
    user.ctx.forward(user.peer)
    return "not this one"


def one() -> int:
    return 1


USES: dict[str, Callable[[User], Any]] = {
    "create_task": in_background,
    "effect": lambda user: waits(user.ctx.effect(one)),
    "every": lambda user: timer(user, user.ctx.every(3600.0, Nothing())),
    "find": lambda user: user.ctx.find(user.peer.path, Peer).path,
    "flush": lambda user: waits(user.ctx.flush()),
    "forward": forwards,
    "life": lambda user: type(user.ctx.life).__name__,
    "link": lambda user: user.ctx.link(user.peer),
    "message_id": lambda user: type(user.ctx.message_id).__name__,
    "monitor": lambda user: monitor(user, user.ctx.monitor(user.peer)),
    "now": lambda user: type(user.ctx.now()).__name__,
    "path": lambda user: user.ctx.path,
    "pipe_to_self": lambda user: user.ctx.pipe_to_self(asyncio.sleep(0), lambda _: Nothing()),
    "publish": publishes,
    "random": lambda user: str(isinstance(user.ctx.random, random.Random)),
    "ref": lambda user: user.ctx.ref.path,
    "reply_handle": handle,
    "sender": lambda user: str(user.ctx.sender),
    "sleep": lambda user: waits(user.ctx.sleep(0.0)),
    "sleep_until": lambda user: waits(user.ctx.sleep_until(0.0)),
    "spawn": lambda user: str(user.ctx.spawn(hf.start(Peer)).path.startswith("/app/user/")),
    "stash": lambda user: user.ctx.stash(),
    "stop": lambda user: user.ctx.stop(),
    "subscribe": lambda user: user.ctx.subscribe("/nothing"),
    "tell_after": lambda user: timer(user, user.ctx.tell_after(3600.0, Nothing())),
    "trap_exits": trap,
    "unlink": lambda user: user.ctx.unlink(user.peer),
    "unstash": lambda user: user.ctx.unstash(),
    "unsubscribe": lambda user: user.ctx.unsubscribe("/nothing"),
    "uuid": lambda user: str(isinstance(user.ctx.uuid(), uuid.UUID)),
    "wait_for": lambda user: waits(user.ctx.wait_for(Nothing, timeout=0.001)),
    "watch": lambda user: monitor(user, user.ctx.watch(user.peer)),
}
NEEDS_RECOVERY = {"message_id", "wait_for"}
"""What an actor without recovery is told that it cannot do."""


def public(kind: type) -> set[str]:
    return {name for name in dir(kind) if not name.startswith("_")}


def kinds_of(kind: type[Any]) -> Iterator[type[Any]]:
    yield kind
    for derived in kind.__subclasses__():
        yield from kinds_of(derived)


def test_each_name_of_the_context_is_used_here() -> None:
    assert public(hf.ActorContext) == set(USES)


@pytest.mark.parametrize("kind", [kind for kind in kinds_of(hf.ActorContext) if kind is not hf.ActorContext])
def test_each_context_is_called_as_every_other_is(kind: type) -> None:
    for name in public(hf.ActorContext):
        ours, theirs = inspect.getattr_static(hf.ActorContext, name), inspect.getattr_static(kind, name)
        assert type(ours) is type(theirs), name
        if inspect.isfunction(ours):
            assert list(inspect.signature(theirs).parameters) == list(inspect.signature(ours).parameters), name


@pytest.mark.parametrize("handle", HANDLES, ids=lambda handle: handle.__name__)
def test_each_handle_has_all_that_its_public_class_has(handle: type[Any]) -> None:
    assert public(handle), "there is something that it can do"
    for kind in HANDLES[handle]:
        assert issubclass(kind, handle)
        for name in public(handle):
            assert inspect.getattr_static(kind, name) is not inspect.getattr_static(handle, name), f"{kind}.{name}"


async def outcomes(place: str, names: Iterable[str]) -> dict[str, list[str]]:
    """What comes of each use; each is made twice."""
    said: dict[str, list[str]] = {}
    async with hf.ActorSystem("app", log=False, intensity=0) as system:
        await system.start(hf.child("peer", hf.start(Peer)))
        spec = hf.child("user", hf.start(User), bindings={"peer": "/app/peer"}, restart="temporary", **PLACES[place])
        user = await system.start(spec)
        for name in names:
            ends = name in ("stash", "stop")
            for _ in range(1 if ends else 2):
                try:
                    reply = await user.ask(Use(name), timeout=0.5 if ends else 30.0)
                except hf.errors.HoldfastError as error:
                    reply = type(error).__name__ if ends else f"{type(error).__name__}: {error}"
                said.setdefault(name, []).append(reply)
    return said


@pytest.mark.parametrize("place", PLACES)
async def test_each_name_of_the_context_does_the_same_in_each_kind_of_actor(place: str) -> None:
    names = [*sorted(USES.keys() - NEEDS_RECOVERY - {"stash", "stop"}), "stash", "stop"]
    plain = await outcomes("plain", names)
    assert await outcomes(place, names) == plain
    assert not any("AttributeError" in reply for replies in plain.values() for reply in replies)


@pytest.mark.parametrize("place", PLACES)
async def test_what_needs_recovery_says_so(place: str) -> None:
    for name in NEEDS_RECOVERY:
        (reply, _) = (await outcomes(place, [name]))[name]
        assert ("with recovery" in reply) == (place in ("plain", "process"))


class Arm(hf.Message):
    what: str


class Ring(hf.Message):
    crashes: bool = False


class Active(hf.Message[list[tuple[str, bool]]]): ...


class Boom(hf.Message): ...


class Rung(hf.Message[int]): ...


class Alarms(hf.Actor):
    """Keeps handles on timers of every kind."""

    def __init__(self) -> None:
        self.timers: dict[str, hf.Timer] = {}
        self.rung = 0

    @hf.on(Arm)
    def arm(self, message: Arm) -> None:
        match message.what:
            case "runs":
                made = self.ctx.tell_after(3600.0, Ring())
            case "runs on":
                made = self.ctx.every(3600.0, Ring())
            case "has come":
                made = self.ctx.tell_after(0.0, Ring())
            case "has crashed":
                made = self.ctx.tell_after(0.0, Ring(crashes=True))
            case _:
                made = self.ctx.tell_after(3600.0, Ring())
                made.cancel()
        self.timers[message.what] = made

    @hf.on(Ring)
    def ring(self, message: Ring) -> None:
        if message.crashes:
            raise ValueError("it was to")
        assert not self.timers["has come"].is_active, "its turn has come"
        self.rung += 1

    @hf.on(Active)
    def active(self, message: Active) -> list[tuple[str, bool]]:
        return sorted((what, one.is_active) for what, one in self.timers.items())

    @hf.on(Rung)
    def read(self, message: Rung) -> int:
        return self.rung

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("it was to")


WANTED = [("cancelled", False), ("has come", False), ("has crashed", False), ("runs", True), ("runs on", True)]


@pytest.mark.parametrize("place", [place for place in PLACES if place not in ("plain", "process", "saved")])
async def test_a_handle_says_in_each_life_whether_its_timer_is_active(place: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        alarms = await system.start(hf.child("alarms", hf.start(Alarms), **PLACES[place]))
        for what, _ in WANTED:
            await alarms.send(Arm(what))
        async with asyncio.timeout(30.0):
            while await alarms.ask(Active(), timeout=20.0) != WANTED or not await alarms.ask(Rung(), timeout=20.0):
                pass
        for saves in (False, True, False):
            if saves and place.startswith("recorded"):
                await system.checkpoint(alarms)
            await alarms.send(Boom())
            assert await alarms.ask(Active(), timeout=20.0) == WANTED
            assert await alarms.ask(Rung(), timeout=20.0) == 1


class Cancel(hf.Message): ...


class Watcher(hf.Actor):
    """Watches its peer twice, and keeps one handle."""

    peer: hf.Binding[Peer]

    def __init__(self) -> None:
        self.watch: hf.Monitor | None = None
        self.downs = 0

    @hf.on(Arm)
    def arm(self, message: Arm) -> None:
        self.watch = self.ctx.watch(self.peer) if message.what == "watch" else self.ctx.monitor(self.peer)

    @hf.on(Cancel)
    def cancel(self, message: Cancel) -> None:
        assert self.watch is not None
        self.watch.cancel()

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError("it was to")

    @hf.on(Rung)
    def read(self, message: Rung) -> int:
        return self.downs

    def on_down(self, source: hf.ActorRef[hf.Actor], reason: hf.ExitReason, recovering: bool) -> None:
        self.downs += 1


@pytest.mark.parametrize("cancels", [True, False], ids=["cancelled", "kept"])
@pytest.mark.parametrize("what", ["watch", "monitor"])
@pytest.mark.parametrize("place", [place for place in PLACES if place not in ("plain", "process")])
async def test_a_monitor_may_be_kept_in_the_state(place: str, what: str, cancels: bool) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        peer = await system.start(hf.child("peer", hf.start(Peer), restart="temporary"))
        spec = hf.child("watcher", hf.start(Watcher), bindings={"peer": peer.path}, **PLACES[place])
        watcher = await system.start(spec)
        await watcher.ask(Arm(what))
        if place.startswith("recorded") or place == "saved":
            await system.checkpoint(watcher)
        await watcher.send(Boom())
        assert await watcher.ask(Rung(), timeout=20.0) == 0
        if cancels:
            await watcher.ask(Cancel(), timeout=20.0)
        await system.stop(peer)
        async with asyncio.timeout(20.0):
            while await watcher.ask(Rung(), timeout=20.0) < (not cancels):
                pass
        assert await watcher.ask(Rung(), timeout=20.0) == (not cancels)
