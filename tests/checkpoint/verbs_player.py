"""The first root of `test_verbs.py`: store, isolation, method, end, moments."""

from __future__ import annotations

import asyncio
import os
import signal
import sys

import holdfast as hf
from tests.checkpoint.test_verbs import FIRST, Act, acting, peers, snapshot, stands


async def main(store: str, isolation: str, name: str, end: str, *moments: str) -> None:
    async with hf.ActorSystem("app", log=False, store=f"sqlite:{store}") as system:
        await peers(system)
        ref = await acting(system, isolation, name, *moments)
        await ref.ask(Act(), timeout=30.0)
        await stands(system, ref, 1)
        if name == "checkpoint_only" or FIRST in moments:
            await snapshot(system, ref)
        if end == "killed":
            os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
