"""A root with a SQLite store for `test_restart_asks.py`: python rejoin_player.py STORE KIND ORDER LIFE.

LIFE "first": an asker's turn asks, and the process ends by SIGKILL while the answer is out. LIFE "second": the tree is
started again, the answer is given, and what the asker has is printed.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from typing import Any

import holdfast as hf

FOREVER = 3600.0


class Question(hf.Message[int]):
    n: int
    how: str
    oracle: hf.ActorRef[Any]


class Go(hf.Message[int]):
    question: Question
    to: hf.ActorRef[Any]


class Open(hf.Message): ...


class Answers(hf.Message[list[int]]): ...


class Asked(hf.Message[int]): ...


class Asker(hf.Actor):
    """Asks in its turn, and keeps the answers."""

    def __init__(self) -> None:
        self.answers: list[int] = []

    @hf.on(Go)
    async def go(self, message: Go) -> int:
        self.answers.append(await message.to.ask(message.question, timeout=60.0))
        return self.answers[-1]

    @hf.on(Answers, readonly=True)
    def read(self, message: Answers) -> list[int]:
        return self.answers


class Relay(hf.Actor):
    """Has somebody else answer."""

    @hf.on(Question)
    def question(self, message: Question) -> Any:
        self.ctx.forward(message.oracle)
        return self.ctx.reply_handle()


class Oracle(hf.Actor):
    """Answers when it is opened: in a later turn, or (how "wait") in the very turn, when the second root is there."""

    def __init__(self) -> None:
        self.waiting: list[tuple[Any, int]] = []
        self.asked = 0

    @hf.on(Question)
    async def question(self, message: Question) -> Any:
        self.asked += 1
        if message.how == "wait":
            if os.environ.get("HOLDFAST_LIFE") == "first":
                os.kill(os.getpid(), signal.SIGKILL)
            return message.n * 10
        self.waiting.append((self.ctx.reply_handle(), message.n))
        return self.waiting[-1][0]

    @hf.on(Open)
    def open(self, message: Open) -> None:
        for handle, n in self.waiting:
            handle.reply(n * 10)
        self.waiting.clear()

    @hf.on(Asked, readonly=True)
    def read(self, message: Asked) -> int:
        return self.asked


async def main(store: str, how: str, order: str, life: str) -> None:
    os.environ["HOLDFAST_LIFE"] = life
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False, intensity=100) as system:
        kinds = {"asker": Asker, "relay": Relay, "oracle": Oracle}
        for name in order.split(","):
            await system.start(hf.child(name, hf.start(kinds[name]), recovery=hf.hybrid(interval=FOREVER)))
        asker, oracle = system.ref("/app/asker", Asker), system.ref("/app/oracle", Oracle)
        if life == "first":
            to: hf.ActorRef[Any] = system.ref("/app/relay", Relay) if how == "forward" else oracle
            for n in (1, 2):
                asker.tell(Go(Question(n, how, oracle), to))
            while await oracle.ask(Asked()) < 1:
                await asyncio.sleep(0)
            if how == "saved":  # The debt is in the snapshot alone.
                await system.checkpoint(oracle)
            await system._homes.settled()
            os.kill(os.getpid(), signal.SIGKILL)
        answers: list[int] = []
        while len(answers) < 2:
            oracle.tell(Open())
            answers = await _soon(asker)
        print(json.dumps([answers, await oracle.ask(Asked())]))


async def _soon(asker: hf.ActorRef[Asker]) -> list[int]:
    """What it has, if its turn is over soon."""
    try:
        return await asker.ask(Answers(), timeout=0.1)
    except hf.AskTimeout:
        return []


if __name__ == "__main__":
    hf.run(main(*sys.argv[1:]))
