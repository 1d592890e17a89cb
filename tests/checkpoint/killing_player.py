"""A root that steps of turns kill, for `test_killing_steps.py`: python killing_player.py STORE [STEPS...].

Each pair of steps is told to an actor of its own, once. A guilty one begins when the one before it was put aside, so
that the same program, started again and again on one store, comes to the end of them: it kills itself in no turn then.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

import holdfast as hf


class Go(hf.Message): ...


class Hello(hf.Message[int]):
    seconds: float = 0.0


class Work(hf.Message):
    first: str
    then: str


class Cancel(hf.Message): ...


def kill() -> int:
    os.kill(os.getpid(), signal.SIGKILL)  # As a fault in a library written in C would.
    return 1


def block_and_kill() -> int:
    time.sleep(0.05)  # Long enough for the loop to have nothing to do.
    return kill()


async def kill_later() -> int:
    await asyncio.sleep(0.01)
    return kill()


async def wait(seconds: float) -> int:
    await asyncio.sleep(seconds)
    return 1


def block(seconds: float) -> int:
    time.sleep(seconds)
    return 1


def refuse() -> int:
    raise OSError


class Friend(hf.Actor):
    @hf.on(Hello)
    async def hello(self, message: Hello) -> int:
        await self.ctx.effect(wait, message.seconds)
        return 1


class Worker(hf.Actor):
    def __init__(self) -> None:
        self.done = 0

    @hf.on(Work)
    async def work(self, message: Work) -> None:
        await self.step(message.first, 0.0)
        if message.then == "fatal async":
            await self.ctx.effect(kill_later)
        elif message.then == "fatal thread":
            await self.ctx.effect(block_and_kill)
        elif message.then == "fatal race":
            racing: list[asyncio.Future[Any]] = [self.ctx.effect(block_and_kill), self.ctx.wait_for(Cancel)]
            await asyncio.wait(racing, return_when=asyncio.FIRST_COMPLETED)
        elif message.then == "fatal code":
            kill()
        else:
            await self.step(message.then, 3600.0)
        self.done += 1

    async def step(self, what: str, seconds: float) -> None:
        match what:
            case "async":
                await self.ctx.effect(wait, seconds)
            case "process":
                await self.ctx.effect(block, seconds, isolation="process")
            case "thread":
                await self.ctx.effect(block, seconds)
            case "slow":
                await self.ctx.effect(block, 1.0)
            case "ask":
                await self.ctx.find(f"/app/friend{seconds:.0f}", Friend).ask(Hello(seconds), timeout=1e6)
            case "wait":
                await self.ctx.wait_for(Go)
            case "sleep":
                await self.ctx.sleep(seconds)
            case "until":
                await self.ctx.sleep_until(self.ctx.now() + seconds)
            case "retried":
                await self.ctx.effect(refuse, retry=hf.Retry(attempts=99, backoff=hf.Backoff(3600.0, maximum=3600.0)))
            case _:
                pass

    @hf.on(Go)
    def go(self, message: Go) -> None: ...

    @hf.on(Cancel)
    def cancel(self, message: Cancel) -> None: ...


async def main(store: str, steps: list[str]) -> None:
    """`steps`: "innocent:FIRST:THEN" of turns that wait for ever, and "guilty:FIRST:THEN" of those that kill."""
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False) as system:
        for name in ("friend0", "friend3600"):
            await system.start(hf.child(name, hf.start(Friend), recovery=hf.hybrid()))
        for index, step in enumerate(steps):
            kind, first, then = step.split(":")
            recovery = hf.hybrid(max_deliveries=3 if kind == "innocent" else 2)
            worker = await system.start(hf.child(f"{kind}{index}", hf.start(Worker), recovery=recovery))
            told = Path(f"{store}-told-{index}")
            if not told.exists():
                await worker.send(Work(first, then))
                if first == "wait":
                    await worker.send(Go())
                told.touch()
            while kind == "guilty" and not system.quarantined(worker):
                await asyncio.sleep(0.01)  # It has to kill this program.
        sys.stdout.write(json.dumps([(one.address, one.attempts) for one in system.quarantined()]) + "\n")
        sys.stdout.flush()
        kill()


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], sys.argv[2:]))
