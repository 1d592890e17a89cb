"""The first root of `test_orders_once.py`: store, isolation, method, end."""

from __future__ import annotations

import asyncio
import os
import signal
import sys

import holdfast as hf
from tests.checkpoint.test_orders_once import IN_TIME, Give, boss_of, is_in_life, victim_at


async def main(store: str, isolation: str, name: str, end: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000, store=f"sqlite:{store}") as system:
        victim = await victim_at(system)
        boss = await boss_of(system, isolation, name)
        await boss.ask(Give(["kill"]), IN_TIME)
        await is_in_life(victim, 2)
        if end == "killed":
            os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
