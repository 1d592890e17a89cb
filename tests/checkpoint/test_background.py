"""Background work that ends without a result: somebody is told, and nothing waits for it any more (T34)."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

import holdfast as hf
from tests.checkpoint.players import start

pytestmark = pytest.mark.pairs


class Begin(hf.Message):
    how: str


class Ended(hf.Message):
    how: str


class Unknown(hf.Message): ...


class Lives(hf.Message[tuple[int, list[str]]]): ...


async def works() -> str:
    return "done"


async def fails() -> str:
    raise OSError("no luck")


async def is_cancelled() -> str:
    work: asyncio.Future[str] = asyncio.get_running_loop().create_future()
    work.cancel()
    return await work


def stumbles(result: Any) -> hf.Message:
    raise LookupError(f"a callback stumbles over {result!r}")


def nothing(result: Any) -> Any:
    return None


def failed(error: BaseException) -> hf.Message:
    return Ended(type(error).__name__)


WAYS: dict[str, tuple[Any, Any, Any]] = {
    "raises": (fails, Ended, None),
    "is cancelled": (is_cancelled, Ended, None),
    "then raises": (works, stumbles, failed),
    "failed raises": (fails, Ended, stumbles),
    "failed raises after a cancellation": (is_cancelled, Ended, stumbles),
    "gives no message": (works, nothing, failed),
    "gives a message of others": (works, lambda _: Unknown(), failed),
}


class Worker(hf.Actor):
    def __init__(self) -> None:
        self.ended: list[str] = []

    @hf.on(Begin)
    def begin(self, message: Begin) -> None:
        if message.how == "told":
            self.ctx.pipe_to_self(is_cancelled(), Ended, failed)
        else:
            work, then, otherwise = WAYS[message.how]
            self.ctx.pipe_to_self(work(), then, otherwise)

    @hf.on(Ended)
    def end(self, message: Ended) -> None:
        self.ended.append(message.how)

    @hf.on(Lives, readonly=True)
    def lives(self, message: Lives) -> tuple[int, list[str]]:
        return self.ctx.life, self.ended


@pytest.fixture(params=["plain", "recorded"])
def method(request: pytest.FixtureRequest) -> hf.Method | None:
    return None if request.param == "plain" else hf.hybrid(interval=3600.0)


@pytest.mark.parametrize("how", WAYS)
async def test_work_that_ends_without_a_message_crashes_the_actor_once(
    how: str, method: hf.Method | None, isolation: str
) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        worker = await start(system, isolation, "worker", hf.start(Worker), recovery=method)
        with system.events() as stream:
            worker.tell(Begin(how))
            async with asyncio.timeout(30.0):
                async for event in stream:
                    if isinstance(event, hf.events.ActorCrashed):
                        break
        assert await worker.ask(Lives(), timeout=30.0) == (2, [])
        if method is not None:  # Nothing is held for it any more.
            await system.checkpoint(worker, timeout=30.0)


class Busy(hf.Actor):
    """Begins a background task that raises, in a turn that is over before it does, or only behind it."""

    def __init__(self) -> None:
        self.begun: list[str] = []

    async def _fail(self) -> None:
        await asyncio.sleep(0)
        raise OSError("no luck")

    @hf.on(Begin)
    async def begin(self, message: Begin) -> None:
        self.begun.append(message.how)
        task = self.ctx.create_task(self._fail())
        if message.how == "within":
            await asyncio.wait([task])

    @hf.on(Lives, readonly=True)
    def lives(self, message: Lives) -> tuple[int, list[str]]:
        return self.ctx.life, self.begun


@pytest.mark.parametrize("how", ["within", "behind"])
async def test_a_task_that_raises_ends_one_life_of_a_recorded_actor(how: str, isolation: str) -> None:
    """A replay of the turn that has begun it would begin it again, and end each life."""
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        busy = await start(system, isolation, "busy", hf.start(Busy), recovery=hf.hybrid(interval=3600.0))
        with system.events() as stream:
            busy.tell(Begin(how))
            async with asyncio.timeout(30.0):
                async for event in stream:
                    if isinstance(event, hf.events.ActorCrashed):
                        break
        assert await busy.ask(Lives(), timeout=30.0) == (2, [how])
        await system.checkpoint(busy, timeout=30.0)
        assert await busy.ask(Lives(), timeout=30.0) == (2, [how])


class Late(Busy):
    """As `Busy`, but its first life is killed before the task has raised."""

    async def _fail(self) -> None:
        if self.ctx.life == 1:
            await asyncio.get_running_loop().create_future()
        await super()._fail()


async def test_a_task_that_a_replay_has_begun_ends_no_replay(isolation: str) -> None:
    """That comes to its end, and is saved, before the life ends by the task: else none would ever be over."""
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        recovery = hf.hybrid(interval=3600.0, pacing="original")  # The task has raised when the next input is due.
        late = await start(system, isolation, "late", hf.start(Late), recovery=recovery)
        begun = ["0", "1", "2"]
        for how in begun:
            await late.ask(Begin(how), timeout=30.0)
        with system.events() as stream:
            late.kill()
            async with asyncio.timeout(30.0):
                while (await late.ask(Lives(), timeout=30.0)) != (3, begun):
                    await asyncio.sleep(0)
            assert not [event for event in stream.take() if isinstance(event, hf.events.RecoveryFailed)]


async def test_cancelled_work_is_a_failure_that_can_be_taken(method: hf.Method | None, isolation: str) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        worker = await start(system, isolation, "worker", hf.start(Worker), recovery=method)
        worker.tell(Begin("told"))
        async with asyncio.timeout(30.0):
            while (await worker.ask(Lives(), timeout=30.0)) != (1, ["CancelledError"]):
                await asyncio.sleep(0)
        if method is not None:
            await system.checkpoint(worker, timeout=30.0)


class Draw(hf.Message[str]):
    how: str


class Drawn(hf.Message):
    number: float


class Said(hf.Message[list[str]]): ...


class Drawing(hf.Actor):
    """Draws beside the turn, and then in the turn."""

    def __init__(self) -> None:
        self.said: list[str] = []
        self._drawn = asyncio.Event()

    def draw(self) -> float:
        return self.ctx.random.random() + len(str(self.ctx.uuid()))

    async def draw_beside(self) -> float:
        number = self.draw()
        self._drawn.set()
        return number

    @hf.on(Draw)
    async def draws(self, message: Draw) -> str:
        match message.how:
            case "effect":
                await self.ctx.effect(self.draw_beside)
            case "thread":
                await self.ctx.effect(self.draw)
            case "task":
                self.ctx.pipe_to_self(self.draw_beside(), Drawn)
                await self.ctx.effect(self._drawn.wait)
        self.said.append(f"{self.ctx.random.random()} {self.ctx.uuid()}")
        return self.said[-1]

    @hf.on(Drawn)
    def drawn(self, message: Drawn) -> None: ...

    @hf.on(Said)
    def tell(self, message: Said) -> list[str]:
        return self.said


@pytest.mark.parametrize("how", ["effect", "thread", "task"])
async def test_who_draws_beside_the_turn_takes_no_number_from_it(how: str, isolation: str) -> None:
    """A replay, in which nobody draws beside it, would see others, and go another way."""
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        ref = await start(system, isolation, "drawing", hf.start(Drawing), recovery=hf.hybrid(interval=3600.0))
        said = await ref.ask(Draw(how), timeout=30.0)
        ref.kill()
        assert await ref.ask(Said(), timeout=30.0) == [said]
