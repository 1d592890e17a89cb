"""A root process with a SQLite store, run by `test_meeting_root.py`: python meeting_player.py STORE SEED STEPS.

It starts and ends journaled dynamic children, and teaches, stops, restarts and erases a ledger, by a seeded plan. What
it is about to do and has done it says on stdout; it is killed in the middle of it. First it says what it has found.
"""

from __future__ import annotations

import json
import random
import sys
from typing import Any

import holdfast as hf


class Put(hf.Message):
    word: str


class All(hf.Message[list[str]]): ...


class Ledger(hf.Actor):
    def __init__(self) -> None:
        self.words: list[str] = []

    @hf.on(Put)
    def put(self, message: Put) -> None:
        self.words.append(message.word)

    @hf.on(All, readonly=True)
    def read(self, message: All) -> list[str]:
        return self.words


def say(word: str) -> None:
    sys.stdout.write(word + "\n")
    sys.stdout.flush()


async def found(system: hf.ActorSystem, pool: hf.ActorRef[Any]) -> dict[str, list[str]]:
    have = {"ledger": await system.ref("/app/top/ledger", Ledger).ask(All(), timeout=30.0)}
    for one in await pool.ask(hf.WhichChildren(), timeout=30.0):
        have[one.id] = await system.ref(one.path, Ledger).ask(All(), timeout=30.0)
    return have


async def step(system: hf.ActorSystem, pool: hf.ActorRef[Any], plan: random.Random, names: list[str]) -> None:
    top = system.ref("/app/top", hf.Supervisor)
    word = f"{plan.getrandbits(32):x}"
    match plan.choice(["put", "put", "stop", "fresh", "delete", "start", "start", "end"]):
        case "put":
            say(f"put {word}")
            await system.ref("/app/top/ledger", Ledger).send(Put(word))
        case "stop":
            say("stop")
            await top.ask(hf.TerminateChild("ledger"), timeout=30.0)
            await top.ask(hf.RestartChild("ledger"), timeout=30.0)
        case "fresh":
            say("fresh")
            await top.ask(hf.TerminateChild("ledger"), timeout=30.0)
            await top.ask(hf.RestartChild("ledger", fresh=True), timeout=30.0)
        case "delete":
            say("fresh")
            spec = await top.ask(hf.supervision.GetChildSpec("ledger"), timeout=30.0)
            await top.ask(hf.TerminateChild("ledger"), timeout=30.0)
            await top.ask(hf.DeleteChild("ledger"), timeout=30.0)
            await top.ask(hf.StartChild(spec), timeout=30.0)
        case "start":
            say(f"start {word}")
            ref = await pool.ask(hf.StartChild(id=word), timeout=30.0)
            await ref.send(Put(word))
            names.append(word)
        case _ if names:
            name = names.pop(plan.randrange(len(names)))
            say(f"end {name}")
            await pool.ask(hf.TerminateChild(name), timeout=30.0)
        case _:
            return
    say("done")


async def main(store: str, seed: int, steps: int) -> None:
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False, intensity=100) as system:
        method = hf.hybrid(interval=0.02)
        await system.start(hf.supervisor("top", children=[hf.child("ledger", hf.start(Ledger), recovery=method)]))
        template = hf.child(None, hf.start(Ledger), recovery=method)
        pool = await system.start(hf.dynamic("pool", template=template, journal=True))
        have = await found(system, pool)
        say(json.dumps(have))
        plan, names = random.Random(seed), [name for name in have if name != "ledger"]
        for _ in range(steps):
            await step(system, pool, plan, names)


if __name__ == "__main__":
    hf.run(main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3])))
