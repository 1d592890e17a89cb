"""A turn that waits, perhaps for days and with ten thousand others, keeps its handler and little else."""

from __future__ import annotations

import asyncio
import gc
import inspect
import types
from pathlib import Path

import pytest

import holdfast as hf
from holdfast.actors.kernel.cell import Cell
from holdfast.actors.turn_stacks import blocked_below, waits_at
from tests.effects.test_long_waits import running, waits

COUNT = 20
IN_TIME = 30.0


class Go(hf.Message): ...


class Wait(hf.Message[str]): ...


class Look(hf.Message[str]): ...


class Flow(hf.Actor):
    """Waits for a message inside of a helper, as workflows do, or gives up and goes on with something else."""

    key_variables = ("stage",)

    def __init__(self) -> None:
        self.stage = "new"
        self.goes_on = asyncio.Event()

    @hf.on(Wait)
    async def wait(self, message: Wait) -> str:
        self.stage = "waits"
        return await self.waited()

    async def waited(self) -> str:
        await self.ctx.wait_for(Go)
        self.stage = "went"
        return "went"

    @hf.on(Go)
    def go(self, message: Go) -> None: ...

    @hf.on(Look, readonly=True)
    def look(self, message: Look) -> str:
        return self.stage


class Went(Flow):
    """Has the message, and waits for something that is none."""

    async def waited(self) -> str:
        await self.ctx.wait_for(Go)
        self.stage = "went"
        await self.goes_on.wait()
        return self.stage


class GaveUp(Flow):
    """Waits no longer than a moment, and then for something that is no message."""

    async def waited(self) -> str:
        try:
            async with asyncio.timeout(0.01):
                await self.ctx.wait_for(Go)
        except TimeoutError:
            self.stage = "gave up"
        await self.goes_on.wait()
        return self.stage


def flow(kind: type[Flow] = Flow, name: str = "flow") -> hf.ChildSpec[Flow]:
    return hf.child(name, hf.start(kind), recovery=hf.hybrid())


def suspended() -> list[str]:
    """The names of all coroutines and generators that are suspended anywhere."""
    gc.collect()
    found = [one for one in gc.get_objects() if isinstance(one, types.CoroutineType | types.GeneratorType)]
    is_coroutine = {False: inspect.getgeneratorstate, True: inspect.getcoroutinestate}
    states = [(one.__qualname__, is_coroutine[isinstance(one, types.CoroutineType)](one)) for one in found]  # type: ignore[operator]
    return sorted(name for name, state in states if state.endswith("SUSPENDED"))


@pytest.mark.parametrize("durability", ["memory", "os"])
async def test_a_turn_that_waits_keeps_no_frames_but_its_handlers(tmp_path: Path, durability: str) -> None:
    """Beside those of the handler there is the one that ends the turn; none drives it, marks it, or waits for it."""
    async with running(tmp_path, durability) as system:
        await system.start(hf.supervisor("flows", children=[flow(name=f"f{n}") for n in range(COUNT)]))
        refs = [system.ref(f"/app/flows/f{n}", Flow) for n in range(COUNT)]
        before = suspended()
        asked = [ref.ask(Wait(), IN_TIME) for ref in refs]
        for ref in refs:
            await waits(system, ref.path)
        more = suspended()
        for name in before:
            more.remove(name)
        own = [name for name in more if name in ("Flow.wait", "Flow.waited", "Fed.finish")]
        assert own == ["Fed.finish"] * COUNT + ["Flow.wait"] * COUNT + ["Flow.waited"] * COUNT
        assert len(more) - len(own) < COUNT, more
        for ref in refs:
            ref.tell(Go())
        assert await asyncio.gather(*asked) == ["went"] * COUNT


@pytest.mark.parametrize("durability", ["memory", "os"])
async def test_where_a_waiting_turn_waits_can_be_seen(tmp_path: Path, durability: str) -> None:
    async with running(tmp_path, durability) as system:
        ref = await system.start(flow())
        asked = ref.ask(Wait(), IN_TIME)
        await waits(system, ref.path)
        cell: Cell = system._node.cell_at(ref.path)
        assert cell.more is not None
        assert cell.more.turn is not None
        assert waits_at(cell.more.turn.coroutine).endswith("await self.ctx.wait_for(Go)")
        shown = blocked_below(cell)
        assert shown.index("return await self.waited()") < shown.index("await self.ctx.wait_for(Go)")
        ref.tell(Go())
        assert await asked == "went"


@pytest.mark.parametrize(("kind", "stage"), [(Went, "went"), (GaveUp, "gave up")])
async def test_a_turn_that_goes_on_rests_no_longer(tmp_path: Path, kind: type[Flow], stage: str) -> None:
    """What only looks is answered beside a turn that rests, and waits for one that is at work."""
    async with running(tmp_path) as system:
        ref = await system.start(flow(kind))
        asked = ref.ask(Wait(), IN_TIME)
        if kind is Went:  # The other one waits for a moment only, which nobody need see on a busy machine.
            await waits(system, ref.path)
        actor = system._node.cell_at(ref.path).actor
        assert isinstance(actor, Flow)
        if kind is Went:
            assert actor.ctx._rests()
            ref.tell(Go())
        async with asyncio.timeout(IN_TIME):
            while actor.stage != stage:
                await asyncio.sleep(0.001)
        assert not actor.ctx._rests(), "a stop would cut it off, and no time limit would count"
        looked = asyncio.ensure_future(ref.ask(Look(), IN_TIME))
        for _ in range(20):
            await asyncio.sleep(0)
        assert not looked.done()
        actor.goes_on.set()
        assert await asked == stage
        assert await looked == stage


async def test_a_kill_reaches_a_turn_that_waits(tmp_path: Path) -> None:
    """Its task is cancelled; the next life waits again, and its turn goes on."""
    async with running(tmp_path, "os") as system:
        ref = await system.start(flow())
        asked = ref.ask(Wait(), IN_TIME)
        for _ in range(3):
            await waits(system, ref.path)
            with system.events() as stream:
                ref.kill()
                await stream.until(hf.events.Recovered, timeout=IN_TIME)
        await waits(system, ref.path)
        ref.tell(Go())
        assert await asked == "went"
