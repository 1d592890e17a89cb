"""The actor whose journals and snapshots lie in `fixtures`, and `make`, which has recorded them.

A fixture is never made again: it is what a holdfast of then has written, and every later one must read it.
"""

from __future__ import annotations

import asyncio
import os
import signal
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

import holdfast as hf

FOLDER = Path(__file__).with_name("fixtures")


class Add(hf.Message[int]):
    n: int


class Lock(hf.Message): ...


class Die(hf.Message): ...


class Show(hf.Message[list[str]]): ...


class Record(hf.Actor):
    """Values of several kinds; after `Lock` no snapshot can be taken, so what follows is in the journal only."""

    def __init__(self, cells: int = 10) -> None:
        self.items: list[int] = []
        self.pairs: dict[Any, Any] = {(1, 2): "x"}
        self.last: deque[int] = deque(maxlen=2)
        self.grid = np.zeros(cells)
        self.lock: Any = None

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.items.append(message.n)
        self.last.append(message.n)
        self.grid[message.n] += 1
        return len(self.items)

    @hf.on(Lock)
    def close(self, message: Lock) -> None:
        self.lock = asyncio.Lock()

    @hf.on(Die)
    def die(self, message: Die) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    @hf.on(Show, readonly=True)
    def show(self, message: Show) -> list[str]:
        ones = [int(one) for one in np.flatnonzero(self.grid)]
        return [repr(self.items), repr(self.pairs), repr(self.last), repr(ones), str(len(self.grid))]


def expected(cells: int) -> list[str]:
    """What every fixture holds: a snapshot after three numbers, and two more in the journal."""
    return ["[1, 2, 3, 4, 5]", "{(1, 2): 'x'}", "deque([4, 5], maxlen=2)", "[1, 2, 3, 4, 5]", str(cells)]


CHECKED = hf.replay_only(check_replay=True, max_deliveries=1)
"""How "checked.db" was recorded."""


async def make_checked(name: str) -> None:
    """Record a journal with digests of states, a message in quarantine, and a group snapshot after three numbers."""
    FOLDER.mkdir(exist_ok=True)
    async with hf.ActorSystem("app", store=f"sqlite:{FOLDER / name}", log=False) as system:
        ref = await system.start(hf.child("record", hf.start(Record, 10), isolation="process", recovery=CHECKED))
        for n in (1, 2, 3):
            await ref.ask(Add(n))
        await system.checkpoint_group([ref], name="three")
        for n in (4, 5):
            await ref.ask(Add(n))
        ref.tell(Die())
        await ref.ask(Show(), timeout=20.0)


async def make(name: str, cells: int) -> None:
    """Record one."""
    FOLDER.mkdir(exist_ok=True)
    async with hf.ActorSystem("app", store=f"sqlite:{FOLDER / name}", log=False) as system:
        ref = await system.start(hf.child("record", hf.start(Record, cells), recovery=hf.hybrid(interval=0.02)))
        with system.events() as stream:
            for n in (1, 2, 3):
                await ref.ask(Add(n))
            async for one in stream:
                if isinstance(one, hf.events.SnapshotTaken) and one.turn >= 3:
                    break
        ref.tell(Lock())
        for n in (4, 5):
            await ref.ask(Add(n))
