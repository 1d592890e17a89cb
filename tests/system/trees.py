"""A tree to change, and a full description of it: two that are equal mean that nothing is different."""

from __future__ import annotations

from typing import Any

import holdfast as hf
from holdfast.actors.kernel.cell import Cell
from holdfast.supervision.supervisor import Supervisor


class Add(hf.Message[int]):
    n: int = 1


class Boom(hf.Message): ...


class Life(hf.Message[int]): ...


class Where(hf.Message[str]): ...


class Counter(hf.Actor):
    def __init__(self, start: int = 0) -> None:
        self.count = start

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.count += message.n
        return self.count

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise RuntimeError("boom")

    @hf.on(Life, readonly=True)
    def life(self, message: Life) -> int:
        return self.ctx.life


class Double(Counter):
    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.count += 2 * message.n
        return self.count


class Client(Counter):
    peer: hf.Binding[Counter]

    @hf.on(Where)
    def where(self, message: Where) -> str:
        return self.peer.path


class Broken(hf.Actor):
    def __init__(self) -> None:
        raise OSError("no such device")


class Slow(Counter):
    """Its start takes longer than anybody waits."""

    async def on_start(self, restored: bool) -> None:
        await self.ctx.create_task(forever())


async def forever() -> None:
    import asyncio

    await asyncio.get_running_loop().create_future()


class Stumble(hf.system.Operation):
    """A step that passes its check and then fails, or does what a test wants in the middle."""

    verb = "stumble over"

    def __init__(self, do: Any = None) -> None:
        super().__init__("a stone")
        self._do = do
        self.calls: list[str] = []

    async def check(self, system: hf.ActorSystem, draft: Any) -> None:
        self.calls.append("check")

    async def prepare(self, system: hf.ActorSystem) -> None:
        self.calls.append("prepare")
        if self._do is None:
            raise hf.HoldfastError("there was a stone")
        await self._do(system)

    async def release(self, system: hf.ActorSystem) -> None:
        self.calls.append("release")


def counter(name: str, start: int = 0, **options: Any) -> hf.ChildSpec:
    return hf.child(name, hf.start(Counter, start), **options)


async def plant(system: hf.ActorSystem) -> None:
    """Three supervisors: `left` with a, b, c; `right` with d and a stopped e; `pool`, which is dynamic, with f."""
    await system.start(hf.supervisor("left", intensity=9, children=[counter(name) for name in "abc"]))
    right = [counter("d"), counter("e", restart="transient"), hf.child("client", hf.start(Client))]
    await system.start(hf.supervisor("right", strategy="one_for_all", intensity=5, children=right))
    pool = await system.start(hf.dynamic("pool", intensity=9))
    await pool.ask(hf.StartChild(counter("f")))
    await system.ref("/app/right", hf.Supervisor).ask(hf.TerminateChild("e"))
    system.bind(ref(system, "/app/right/client"), "peer", ref(system, "/app/left/a"))
    system.register("first", ref(system, "/app/left/a"))
    system.register("second", ref(system, "/app/left/b"))


def ref(system: hf.ActorSystem, path: str) -> hf.ActorRef[Any]:
    return system.ref(path, hf.Actor)


def picture(system: hf.ActorSystem) -> dict[str, Any]:
    """All there is to be seen of a tree."""
    node = system._node
    assert node.root is not None
    cells = dict(everything(node.root))
    return {
        "tree": system.tree(),
        "cells": {path: describe(cell) for path, cell in cells.items()},
        "names": [(name, cell.path) for name, cell in node.names.items()],
        "elsewhere": {path for path in PATHS if path not in cells and node.find(path) is not None},
    }


PATHS = [f"/app/{above}/{name}" for above in ("left", "right", "pool") for name in "abcdefghij"]


def everything(cell: Cell) -> Any:
    yield cell.path, cell
    for child in (cell.children or {}).values():
        yield from everything(child)


def describe(cell: Cell) -> dict[str, Any]:
    actor, more = cell.actor, cell.extra()
    told: dict[str, Any] = {
        "cell": id(cell),
        "actor": id(actor),
        "class": type(actor),
        "life": cell.life,
        "state": cell.state,
        "spec": cell.spec,
        "start": more.start,
        "suspended": more.suspended,
        "bindings": {port: target.path for port, target in more.bindings.items()},
        "count": getattr(actor, "count", None),
    }
    if isinstance(actor, Supervisor):
        told["flags"] = actor._flags
        told["children"] = [
            (one.spec, one.state, None if one.cell is None or one.cell.state == "gone" else id(one.cell))
            for one in actor._children.values()
        ]
    return told
