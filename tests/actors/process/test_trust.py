"""Orders from a process go to what it has started and to what it is bound to; names of those gone are forgotten."""

from __future__ import annotations

import contextlib
import gc
import os
import resource
import signal
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.kernel.cell import Cell
from holdfast.actors.process.wire.name_table import MOST_NAMES
from tests.actors.process.waiting import SECONDS, next_event

pytestmark = pytest.mark.pairs


class Order(hf.Message[str]):
    """Stop, kill, or start a child somewhere; the reply is the error, if there is one."""

    verb: str
    path: str


class Ping(hf.Message[int]): ...


class Pid(hf.Message[int]): ...


class Names(hf.Message[int]):
    """How many addresses of other processes this one remembers."""


class Worker(hf.Actor):
    port: hf.Binding[hf.Actor]

    @hf.on(Order)
    async def order(self, message: Order) -> str:
        ref: hf.ActorRef[Any] = self.ctx.find(message.path, hf.Actor)
        try:
            if message.verb == "start":
                await ref.ask(hf.StartChild(args=("x",), id="made"))
            else:
                getattr(ref, message.verb)()
        except hf.errors.NotGranted as error:
            return str(error)
        return ""

    @hf.on(Ping)
    def ping(self, message: Ping) -> int:
        return 1

    @hf.on(Pid)
    def pid(self, message: Pid) -> int:
        return os.getpid()

    @hf.on(Names)
    def names(self, message: Names) -> int:
        gc.collect()
        return len(self.ctx._cell.node.ports.uplink._outside)


class Job(hf.Actor):
    def __init__(self, name: str = "") -> None:
        self.name = name

    @hf.on(Ping)
    async def ping(self, message: Ping) -> int:
        return await self.ctx.find("/app/worker", Worker).ask(message)


@pytest.mark.parametrize("verb", ["stop", "kill", "start"])
@pytest.mark.parametrize("recovery", [None, hf.hybrid()], ids=["plain", "recorded"])
async def test_an_order_needs_a_binding(system: hf.ActorSystem, verb: str, recovery: Any) -> None:
    jobs = await system.start(hf.child("one", hf.start(Job)))
    path = "/app" if verb == "start" else jobs.path
    worker = await system.start(hf.child("worker", hf.start(Worker), isolation="process", recovery=recovery))
    told = await worker.ask(Order(verb, path), timeout=SECONDS)
    assert "may not order" in told
    assert path in told
    assert await worker.ask(Ping(), timeout=SECONDS) == 1
    assert "/app/one" in system.tree()


async def test_a_binding_grants_orders(system: hf.ActorSystem) -> None:
    for name in ("one", "two"):
        await system.start(hf.child(name, hf.start(Job), restart="temporary"))
    bound = {"port": "/app/one"}
    worker = await system.start(hf.child("worker", hf.start(Worker), isolation="process", bindings=bound))
    with system.events() as events:
        assert await worker.ask(Order("kill", "/app/one"), timeout=SECONDS) == ""
        assert (await next_event(events, hf.events.ChildTerminated)).address == "/app/one"
    assert "may not order" in await worker.ask(Order("kill", "/app/two"), timeout=SECONDS)
    async with system.transaction() as change:
        change.bind(worker, "port", system.ref("/app/two", Job))
    with system.events() as events:
        assert await worker.ask(Order("kill", "/app/two"), timeout=SECONDS) == ""
        assert (await next_event(events, hf.events.ChildTerminated)).address == "/app/two"


async def test_who_asked_once_is_not_remembered(system: hf.ActorSystem) -> None:
    """A process that serves one actor per request knows the address of none of them for ever."""
    worker = await system.start(hf.child("worker", hf.start(Worker), isolation="process"))
    for at in range(MOST_NAMES + 500):
        job = system.spawn(hf.start(Job), f"job-{at}")
        assert await job.ask(Ping(), timeout=SECONDS) == 1
        job.kill()
    assert await worker.ask(Names(), timeout=SECONDS) < 1000
    connection = system._workers.by_cell[worker._cell].connection
    assert len(connection.names._given) < 1500


async def test_links_outlive_the_forgetting_of_names(system: hf.ActorSystem) -> None:
    """Names begin anew while asks are open and messages are on their way, in order."""
    worker = await system.start(hf.child("worker", hf.start(Worker), isolation="process"))
    for at in range(MOST_NAMES + 10):
        cell = Cell(system._node, None, f"/app/nobody-{at}", system._node.ports.here)
        system._workers.by_cell[worker._cell].connection.names.to_wire(cell.path)
    asks = [worker.ask(Ping(), timeout=SECONDS) for _ in range(100)]
    assert [await ask for ask in asks] == [1] * 100


async def test_no_descriptors_left_is_no_fault_of_the_actor() -> None:
    """A restart that finds no descriptor is tried again for a while, and does not spend the restarts."""
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    held: list[int] = []
    async with hf.ActorSystem("app", log=False, intensity=2, period=60.0) as system:
        worker = await system.start(hf.child("worker", hf.start(Worker), isolation="process"))
        pid = await worker.ask(Pid(), timeout=SECONDS)
        try:
            resource.setrlimit(resource.RLIMIT_NOFILE, (256, before[1]))
            workers = system._workers
            for warm in list(workers._ready):
                await warm.gone()
            try:
                while True:
                    held.append(os.open("/dev/null", os.O_RDONLY))
            except OSError:
                pass
            with system.events() as events:
                os.kill(pid, signal.SIGKILL)
                await next_event(events, hf.events.ChildRestarted)
            for file in held[:64]:
                os.close(file)
            held = held[64:]
            assert await worker.ask(Ping(), timeout=SECONDS) == 1
        finally:
            for file in held:
                os.close(file)
            resource.setrlimit(resource.RLIMIT_NOFILE, before)


class Cut(hf.Message[list[str]]):
    """Cut all shared memory short; the reply is what could not be."""


class Cutter(hf.Actor):
    def __init__(self) -> None:
        self.block = bytes(1 << 20)

    @hf.on(Cut)
    def cut(self, message: Cut) -> list[str]:
        refused = []
        for name in os.listdir("/proc/self/fd"):
            file = f"/proc/self/fd/{name}"
            with contextlib.suppress(FileNotFoundError):
                if "memfd:holdfast" in os.readlink(file):
                    try:
                        os.truncate(file, 0)
                    except PermissionError:
                        refused.append(os.readlink(file).split(":")[1].split()[0])
        return refused


@pytest.mark.parametrize("recovery", [None, hf.hybrid(interval=3600.0)], ids=["plain", "recorded"])
async def test_memory_that_is_shared_with_the_root_cannot_be_cut_short(system: hf.ActorSystem, recovery: Any) -> None:
    cutter = await system.start(hf.child("cutter", hf.start(Cutter), isolation="process", recovery=recovery))
    if recovery is not None:
        await system.checkpoint(cutter)
    refused = await cutter.ask(Cut(), timeout=SECONDS)
    assert "holdfast-page" in refused
    assert ("holdfast" in refused) is (recovery is not None)  # the blocks of its snapshot
    if recovery is not None:
        await system.checkpoint(cutter)  # The root reads what it has.
    assert await cutter.ask(Cut(), timeout=SECONDS)
