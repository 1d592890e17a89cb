"""An actor that does what it is told, in tests of turns and of their ends."""

import asyncio
from collections.abc import Callable
from typing import Any

import holdfast as hf


class Do(hf.Message[Any]):
    """Run this in the actor's turn: `work(actor)`, awaited if it is a coroutine."""

    work: Any


class DoNow(hf.Message[Any]):
    """The same in a plain `def` handler."""

    work: Any


class Doer(hf.Actor):
    @hf.on(Do)
    async def do(self, message: Do) -> Any:
        result = message.work(self)
        return await result if asyncio.iscoroutine(result) else result

    @hf.on(DoNow)
    def do_now(self, message: DoNow) -> Any:
        return message.work(self)


Doers = Callable[[], hf.ActorRef[Doer]]


async def pause(turns: int = 1) -> None:
    for _ in range(turns):
        await asyncio.sleep(0)
