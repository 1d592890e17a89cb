"""Everything that can be changed of a child of a supervisor, there and back, and what its children are like then."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from collections.abc import Awaitable, Callable
from typing import Any

import holdfast as hf
from holdfast.actors.process.resource_limits import Limits
from holdfast.ftm.group import probation
from holdfast.supervision.spec import Isolation


class Tell(hf.Message[list[Any]]):
    """Say what you are, in which process, what you have counted and to whom you are bound."""


class Count(hf.Message[None]): ...


class Peer(hf.Actor): ...


class Old(hf.Actor):
    peer: hf.Binding[Peer]

    def __init__(self, step: int = 1) -> None:
        self.step, self.total = step, 0

    @hf.on(Count)
    def count(self, message: Count) -> None:
        self.total += self.step

    @hf.on(Tell, readonly=True)
    def tell(self, message: Tell) -> list[Any]:
        return [type(self).__name__, os.getpid(), self.total, self.peer.path]


class New(hf.Actor):
    """The next release: it counts in hundredths."""

    schema_version = 2
    peer: hf.Binding[Peer]

    def __init__(self, step: int = 1) -> None:
        self.step, self.hundredths = step, 0

    @classmethod
    def migrate(cls, state: dict[str, Any], from_version: int) -> dict[str, Any]:
        return {"step": state["step"], "hundredths": 100 * state["total"]}

    @hf.on(Count)
    def count(self, message: Count) -> None:
        self.hundredths += 100 * self.step

    @hf.on(Tell, readonly=True)
    def tell(self, message: Tell) -> list[Any]:
        return [type(self).__name__, os.getpid(), self.hundredths // 100, self.peer.path]


class Wrong(Old):
    """A release that does not fit what the last one has recorded."""


def back(state: dict[str, Any]) -> dict[str, Any]:
    return {"step": state["step"], "total": state["hundredths"] // 100}


BOUND = {"peer": "/app/first"}
OPTIONS: dict[str, Any] = {"restart": "permanent", "shutdown": 5.0, "backoff": None, "start_timeout": 60.0}
OTHERS: dict[str, Any] = {"restart": "transient", "shutdown": 4.0, "backoff": hf.Backoff(initial=0.01)}
NAMES = ("same", "code", "start", "by_order", "place", "limits", "options", "bind", "gone", "moved", "guarded")
KINDS = ("template", "spec", "plain")
IN = hf.child(
    "guest",
    hf.start(New, 5),
    restart="transient",
    recovery=hf.checkpoint_only(),
    mailbox=hf.bounded(7),
    bindings=BOUND,
)


PROBATION = {"SECONDS": 0.0, "TURNS": 0, "LOOK_EVERY": 0.05}


def member(name: str | None) -> hf.ChildSpec:
    return hf.child(name, hf.start(Old), recovery=hf.hybrid(), bindings=BOUND)


def trees(kind: str, place: Isolation = "task") -> list[hf.ChildSpec]:
    first = [hf.child("first", hf.start(Peer)), hf.child("second", hf.start(Peer))]
    if kind == "plain":
        team = hf.supervisor("team", children=[member(name) for name in NAMES], intensity=100, isolation=place)
    else:
        template = member(None) if kind == "template" else None
        team = hf.dynamic("team", template=template, journal=True, intensity=100, isolation=place)
    return [*first, hf.supervisor("others", children=[IN], intensity=100), team]


def of_template() -> list[hf.ChildSpec]:
    return trees("template", "process")


async def begin(system: hf.ActorSystem, kind: str, place: Isolation = "task") -> None:
    for tree in trees(kind, place):
        await system.start(tree)


async def come(system: hf.ActorSystem, kind: str, *names: str) -> None:
    team = system.ref("/app/team", hf.Supervisor)
    for name in names:
        if kind == "template":
            await team.ask(hf.StartChild(id=name, kwargs={"step": 2}))
        else:
            await team.ask(hf.StartChild(member(name)))


def at(name: str) -> str:
    return f"/app/team/{name}"


async def there(system: hf.ActorSystem, kind: str) -> None:
    """Change one thing of each."""
    if kind != "plain":
        await come(system, kind, *NAMES)
    for name in NAMES:
        await system.ref(at(name)).ask(Count())
    if kind != "plain":
        await system.replace_code(await paused(system, "by_order"), New)
        await system.resume(system.ref(at("by_order")))
        await system.set_isolation(system.ref(at("limits")), "process", limits=Limits(niceness=3))
    async with system.transaction() as change:
        change.replace_code(at("code"), New)
        change.replace_code(at("start"), hf.start(Old, 7))
        change.isolation(at("place"), "process")
        change.respecify(at("options"), register="till", **OTHERS)
        change.bind(at("bind"), "peer", "/app/second")
        change.remove(at("gone"))
        change.move(at("moved"), "/app/others")
        change.protect(at("guarded"), hf.ftm.PBR())
        if kind != "template":  # Which takes nobody from elsewhere.
            change.move("/app/others/guest", "/app/team")
    await change.settled()


async def and_back(system: hf.ActorSystem, kind: str) -> None:
    """The same, back to what it was."""
    if kind != "plain":
        await system.replace_code(await paused(system, "by_order"), Old, back)
        await system.resume(system.ref(at("by_order")))
        await system.set_isolation(system.ref(at("limits")), "task")
    async with system.transaction() as change:
        change.replace_code(at("code"), Old, back)
        change.replace_code(at("start"), hf.start(Old, 1))
        change.isolation(at("place"), "task")
        change.respecify(at("options"), register=None, **OPTIONS)
        change.bind(at("bind"), "peer", "/app/first")
        change.protect(at("guarded"), None)
        if kind != "template":
            change.move("/app/others/moved", "/app/team")
            change.move(at("guest"), "/app/others")
        if kind == "plain":
            change.add("/app/team", member("gone"))
    await change.settled()
    if kind != "plain":
        await come(system, kind, "gone")


TEMPLATE = hf.child(None, hf.start(New), recovery=hf.hybrid(), bindings=BOUND)
RENEWALS = ("template, transactions", "template, one transaction", "template, orders", "orders, template")


async def renewed(system: hf.ActorSystem, renewal: str) -> None:
    """All children, and those that come later, are of the next release."""
    await come(system, "template", "one", "two")
    for name in ("one", "two"):
        await system.ref(at(name)).ask(Count())
    for step in renewal.split(", "):
        await _renew(system, step)
    await come(system, "template", "three")
    for name in ("one", "two", "three"):
        await system.ref(at(name)).ask(Count())


async def _renew(system: hf.ActorSystem, step: str) -> None:
    match step:
        case "template":
            await system.ref("/app/team", hf.Supervisor).ask(hf.supervision.ChangeSupervisor(children=[TEMPLATE]))
        case "one transaction":
            async with system.transaction() as change:
                for name in ("one", "two"):
                    change.replace_code(at(name), New)
        case "transactions":
            for name in ("one", "two"):
                async with system.transaction() as change:
                    change.replace_code(at(name), New)
        case _:
            for name in ("one", "two"):
                await system.replace_code(await paused(system, name), New)
                await system.resume(system.ref(at(name)))


async def paused(system: hf.ActorSystem, name: str) -> hf.ActorRef[Any]:
    await system.suspend(system.ref(at(name)))
    return system.ref(at(name))


async def looks(system: hf.ActorSystem) -> dict[str, list[Any]]:
    """What the children of both supervisors are like."""
    seen: dict[str, list[Any]] = {}
    for above in ("/app/team", "/app/others"):
        supervisor = system.ref(above, hf.Supervisor)
        for one in await supervisor.ask(hf.WhichChildren(), timeout=20.0):
            ref: hf.ActorRef[Any] = system.ref(one.path)
            spec = await supervisor.ask(hf.supervision.GetChildSpec(one.id))
            kind, pid, total, peer = await ref.ask(Tell(), timeout=30.0)
            said = (spec.restart, spec.shutdown, spec.backoff, spec.register, spec.isolation, spec.limits)
            where = "task" if pid == os.getpid() else "process"
            stack = list((await system.protection(ref)).stack)
            seen[one.path] = [kind, where, total, peer, repr((*said, spec.mailbox, spec.recovery)), stack]
    return seen


Step = Callable[[hf.ActorSystem, str], Awaitable[None]]
DIRECTIONS: dict[str, tuple[Step, ...]] = {"there": (there,), "back": (there, and_back)}


async def first(
    store: str, kind: str, direction: str, place: Isolation = "task", *, is_killed: bool
) -> dict[str, list[Any]]:
    """A first program; it dies in the end, or ends in order."""
    async with hf.ActorSystem("app", store=store, log=False, intensity=100) as system:
        await begin(system, kind, place)
        if direction in RENEWALS:
            await renewed(system, direction)
        for step in DIRECTIONS.get(direction, ()):
            await step(system, kind)
        seen = await looks(system) if place == "task" else {}  # What specs say in a process, only that reads.
        if is_killed:
            print(json.dumps(seen), flush=True)
            os.kill(os.getpid(), signal.SIGKILL)
        return seen


def main() -> None:
    """Live the first program, with the arguments of the command, and die."""
    for name, value in PROBATION.items():
        setattr(probation, name, value)
    store, kind, direction, place = sys.argv[1:]
    asyncio.run(first(store, kind, direction, "process" if place == "process" else "task", is_killed=True))
