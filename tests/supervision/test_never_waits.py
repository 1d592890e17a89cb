"""A supervisor never waits in its own turn for what it supervises; what its end waits for is limited."""

import asyncio
import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from typing import Any

import pytest

import holdfast as hf

virtual = pytest.mark.asyncio(loop_factories=["virtual"])


def supervisors() -> Iterator[type[hf.Supervisor]]:
    """All supervisor classes of the package, those of mechanisms and of their replicas among them."""
    for room in ("supervision", "ftm", "system", "checkpoint", "diagnosis"):
        package = importlib.import_module(f"holdfast.{room}")
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            importlib.import_module(found.name)
    waiting = [hf.Supervisor]
    while waiting:
        kind = waiting.pop()
        waiting.extend(kind.__subclasses__())
        if kind.__module__.startswith("holdfast."):
            yield kind


def test_no_handler_of_a_supervisor_can_wait() -> None:
    """What takes its time is an errand. (`no_supervisor_waits` in conftest.py looks at every turn of all tests.)"""
    found = {
        f"{kind.__name__}.{handler.__name__}"
        for kind in supervisors()
        for handler in kind._table.values()
        if inspect.iscoroutinefunction(handler)
    }
    assert not found
    starts = {kind for kind in supervisors() if inspect.iscoroutinefunction(vars(kind).get("on_start"))}
    assert starts == {hf.Supervisor}  # Its own start is an errand, too.
    names = {kind.__name__ for kind in supervisors()}
    assert {"Supervisor", "DynamicSupervisor", "PoolSupervisor", "PartitionSupervisor", "Replica"} <= names


class Block(hf.Message): ...


class Blocked(hf.Supervisor):
    """Breaks the rule."""

    @hf.on(Block)
    async def wait_for_ever(self, message: Block) -> None:
        await asyncio.Event().wait()


class Kid(hf.Actor): ...


def blocked(**options: Any) -> hf.ChildSpec:
    return hf.supervisor("top", children=[hf.child("kid", hf.start(Kid), **options)], kind=Blocked)


@virtual
@pytest.mark.parametrize("what", ["it", "the supervisor above", "the system"])
async def test_an_end_that_hangs_is_told_with_its_stacks_and_made(what: str) -> None:
    """The child's 3 s, one for its kill, and five more."""
    loop = asyncio.get_running_loop()
    async with hf.ActorSystem(log=False) as system:
        await system.start(hf.supervisor("above", children=[blocked(shutdown=3.0)]))
        top = system.ref("/app/above/top", Blocked)
        top.tell(Block())
        await asyncio.sleep(1.0)
        before = loop.time()
        with system.events() as events:
            if what == "the system":
                await system.shutdown()
            else:
                await system.stop(top if what == "it" else system.ref("/app/above", hf.Supervisor))
            (told,) = [event for event in events.take() if isinstance(event, hf.events.StopOverdue)]
        assert loop.time() - before == pytest.approx(9.0, abs=0.5)
        assert (told.address, told.seconds) == ("/app/above/top", 9.0)
        assert "/app/above/top (running) has been in the turn of Block" in told.stacks
        assert "in Blocked.wait_for_ever" in told.stacks
        assert "await asyncio.Event().wait()" in told.stacks


@virtual
async def test_a_start_and_a_stop_that_wait_for_a_suspended_supervisor_are_told() -> None:
    class Quick(hf.Actor):
        """Has nothing to do."""

    async with hf.ActorSystem(log=False) as system:
        first = await system.start(hf.child("first", hf.start(Quick)))
        root, loop = system.ref("/app", hf.Supervisor), asyncio.get_running_loop()
        with system.events() as events:
            await system.start(hf.child("second", hf.start(Quick)))
            await system.suspend(root)
            starting = asyncio.create_task(system.start(hf.child("third", hf.start(Quick))))
            held = await events.until(hf.events.OrderHeld)
            assert (held.address, held.order, held.child, held.seconds) == ("/app", "start", "/app/third", 5.0)
            await system.resume(root)
            await starting
            await system.suspend(root)
            stopping = asyncio.create_task(system.stop(first))
            await asyncio.sleep(60.0)
            [held] = [event for event in events.take() if isinstance(event, hf.events.OrderHeld)]
            assert (held.order, held.child, held.seconds) == ("stop", "/app/first", 5.0)
            await system.resume(root)
            await stopping
            await asyncio.sleep(60.0)
            assert not [event for event in events.take() if isinstance(event, hf.events.OrderHeld)]
        assert loop.time() == pytest.approx(125.0, abs=0.5)


@virtual
async def test_a_leaf_that_may_take_for_ever_is_waited_for() -> None:
    class Slow(hf.Actor):
        async def on_stop(self, reason: hf.ExitReason) -> None:
            await asyncio.sleep(10_000.0)

    async with hf.ActorSystem(log=False) as system:
        children = [hf.child("slow", hf.start(Slow), shutdown="infinity")]
        await system.start(hf.supervisor("above", children=[hf.supervisor("top", children=children)]))
        with system.events() as events:
            await system.shutdown()
            assert not [event for event in events.take() if isinstance(event, hf.events.StopOverdue)]
    assert asyncio.get_running_loop().time() == pytest.approx(10_000.0)


@virtual
@pytest.mark.parametrize("dynamic", [False, True])
async def test_a_supervisor_has_the_time_of_all_its_children(dynamic: bool) -> None:
    """One after another, or all at once; those that have to be killed take one second more."""

    class Slow(hf.Actor):
        async def on_stop(self, reason: hf.ExitReason) -> None:
            await asyncio.sleep(7.9)

    specs = [hf.child(str(number), hf.start(Slow), shutdown=8.0) for number in range(5)]
    async with hf.ActorSystem(log=False) as system:
        if dynamic:
            top = await system.start(hf.dynamic("top"))
            for spec in specs:
                await top.ask(hf.StartChild(spec))
        else:
            top = await system.start(hf.supervisor("top", children=specs))
        with system.events() as events:
            await system.stop(top)
            assert not [
                event for event in events.take() if isinstance(event, (hf.events.StopOverdue, hf.events.ShutdownError))
            ]
    assert asyncio.get_running_loop().time() == pytest.approx(7.9 if dynamic else 39.5)
