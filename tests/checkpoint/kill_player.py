"""A root process that is killed under load, run by `test_kills.py`: python kill_player.py STORE DURABILITY [N ...].

Eight callers at once send numbers to a recorded actor in a process, which passes them on to another one, a task. What
was accepted is said on stdout. Caller c begins with the c-th N. Without any N it only says what the two have.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
from typing import Any

import holdfast as hf


class Put(hf.Message[int]):
    caller: int
    n: int
    to: hf.ActorRef[hf.Actor] | None = None


class All(hf.Message[list[list[int]]]): ...


class Ledger(hf.Actor):
    """Keeps each number, and passes it on if it is told to whom."""

    def __init__(self) -> None:
        self.numbers: list[list[int]] = []

    @hf.on(Put)
    def put(self, message: Put) -> int:
        self.numbers.append([message.caller, message.n])
        if message.to is not None:
            message.to.tell(Put(message.caller, message.n))
        return message.n

    @hf.on(All, readonly=True)
    def read(self, message: All) -> list[list[int]]:
        return self.numbers


async def call(caller: int, n: int, first: hf.ActorRef[Any], second: hf.ActorRef[Any]) -> None:
    while True:
        if n % 3:
            await first.send(Put(caller, n, second))
        else:
            assert await first.ask(Put(caller, n, second), timeout=60.0) == n
        os.write(1, b"%d %d\n" % (caller, n))  # From here on it must not get lost.
        n += 1


async def main(store: str, durability: Any, begin: list[int]) -> None:
    system = hf.ActorSystem("app", store=f"sqlite:{store}", durability=durability, log=False, intensity=1000)
    async with system:
        recovery = hf.hybrid(interval=0.03)
        second = await system.start(hf.child("second", hf.start(Ledger), recovery=recovery))
        first = await system.start(hf.child("first", hf.start(Ledger), isolation="process", recovery=recovery))
        if begin:
            await asyncio.gather(*[call(caller, n, first, second) for caller, n in enumerate(begin)])
        for actor in (first, second):  # Behind everything that was there: tells between the two have been counted.
            await actor.ask(All(), timeout=60.0)
        have = [await actor.ask(All(), timeout=60.0) for actor in (first, second)]
        os.write(1, json.dumps(have).encode() + b"\n")


if __name__ == "__main__":
    hf.run(main(sys.argv[1], sys.argv[2], [int(word) for word in sys.argv[3:]]))
