"""Actors that end in all the ways there are, and a root that is killed."""

import asyncio
import os
import signal
import time
from collections.abc import Callable
from typing import Any

import holdfast as hf


class Do(hf.Message[int]):
    """Do this, and answer with the number of things done so far."""

    what: str


class Worker(hf.Actor):
    """Does as it is told, also what it should not."""

    def __init__(self) -> None:
        self.done = 0
        self.seen = 0.0

    @hf.on(Do)
    async def do(self, message: Do) -> int:
        self.done += 1
        match message.what:
            case "crash":
                raise ZeroDivisionError("nothing to divide")
            case "kill":
                os.kill(os.getpid(), signal.SIGKILL)
            case "eat":
                raise MemoryError("all gone")
            case "exit":
                os._exit(3)
            case "hang":
                time.sleep(60.0)
            case "clock":
                self.seen = time.time()
                return int(self.seen * 1e6)
            case "block":
                time.sleep(0.3)
            case "stop":
                self.ctx.stop()
            case "wait":
                await asyncio.sleep(60.0)
            case _:
                pass
        return self.done


async def upload() -> int:
    """Do something that takes a minute."""
    await asyncio.sleep(60.0)
    return 1


class Sleeper(hf.Actor):
    """Rests in its turns, as it says by its context."""

    @hf.on(Do)
    async def do(self, message: Do) -> int:
        if message.what == "sleep":
            await self.ctx.sleep(20.0)
            return 0
        return await self.ctx.effect(upload, key="upload")


class Pass(hf.Message[int]):
    """Ask another one to do this, and wait for its answer."""

    to: hf.ActorRef[Worker]
    what: str


class Caller(hf.Actor):
    """Asks others."""

    @hf.on(Pass)
    async def on_pass(self, message: Pass) -> int:
        return await message.to.ask(Do(message.what), 60.0)


class Strike(hf.Message):
    """Kill whom you are bound to."""


class Killer(hf.Actor):
    """Kills another one."""

    whom: hf.Binding[Worker]

    @hf.on(Strike)
    def strike(self, message: Strike) -> None:
        self.whom.kill()


class SlowStarter(Worker):
    """Waits in its start for as long as a file is not there."""

    def __init__(self, file: str) -> None:
        super().__init__()
        self.file = file

    async def on_start(self, restored: bool) -> None:
        while not os.path.exists(self.file):
            await asyncio.sleep(0.01)


class Stubborn(hf.Actor):
    """Does not start."""

    def __init__(self) -> None:
        raise FileNotFoundError("no file of settings")


class Fickle(Worker):
    """Starts once, in this process, and never again."""

    started = 0

    def __init__(self) -> None:
        super().__init__()
        Fickle.started += 1
        if Fickle.started > 1:
            raise FileNotFoundError("the file of settings has gone")


async def failed(ref: hf.ActorRef[Any], what: str) -> None:
    """Have the actor fail, and wait until whoever asked hears of it."""
    try:
        await ref.ask(Do(what), 20.0)
    except hf.HoldfastError:
        return
    raise AssertionError(f"{what} was answered")


async def until(holds: Callable[[], object], seconds: float = 10.0) -> None:
    """Wait until something holds."""
    async with asyncio.timeout(seconds):
        while not holds():
            await asyncio.sleep(0.01)


async def root(path: str) -> None:
    """A root on a store whose actors fail, and that is then killed; it says when there is something to see."""
    async with hf.ActorSystem("app", store=f"sqlite:{path}", log=False) as system:
        worker = await system.start(hf.child("worker", hf.start(Worker), recovery=hf.hybrid()))
        await failed(worker, "crash")
        await worker.ask(Do("well"))
        await asyncio.sleep(0.6)  # The history is written a few times a second.
        print("ready", flush=True)
        await asyncio.sleep(60.0)
