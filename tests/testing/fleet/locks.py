"""A service with a planted bug that shows only when a network is split: a lock that two programs give at once."""

from __future__ import annotations

import asyncio

import holdfast as hf
from holdfast.testing import Faults
from holdfast.testing.fleet.guarded_fleet import GuardedFleet
from holdfast.testing.fleet.sim_fleet import SimProgram, SimServers

LEASE = 5.0
"""Seconds for which a lock is given."""


class Grant(hf.Message[bool]):
    holder: str


class Lock(hf.Actor):
    """Is given to one holder at a time; a new life first waits until what the last one has given is over."""

    def __init__(self) -> None:
        self.holder, self.until = "", 0.0

    def on_start(self, restored: bool) -> None:
        if not restored:
            self.until = self.ctx.now() + LEASE + 1.0

    @hf.on(Grant)
    def grant(self, message: Grant) -> bool:
        now = self.ctx.now()
        if self.holder != message.holder and now < self.until:
            return False
        self.holder, self.until = message.holder, now + LEASE
        return True


async def give_locks(program: SimProgram) -> None:
    """It keeps nothing: its leader may have been replaced, and goes on to give the lock."""
    async with program.open() as system:
        await system.start(hf.child("lock", hf.start(Lock)))
        await asyncio.Event().wait()


async def give_recorded_locks(program: SimProgram) -> None:
    """What it gives is in the log before anybody hears of it."""
    async with program.open() as system:
        await system.start(hf.child("lock", hf.start(Lock), recovery=hf.hybrid()))
        await asyncio.Event().wait()


async def hold(servers: SimServers, held: dict[str, float], name: str, *, times: int, pause: float) -> None:
    """Call the service anew and again, and see to it that nobody else holds what it gives."""
    loop = asyncio.get_running_loop()
    for _ in range(times):
        asked = loop.time()
        try:
            async with hf.connect(servers, timeout=3.0) as connection:
                asked = loop.time()
                is_given = await connection.ref("/app/lock", Lock).ask(Grant(name), timeout=2.0)
        except (hf.AskTimeout, hf.AskFailed, hf.SendError):
            is_given = False
        if is_given and loop.time() < asked + LEASE:
            others = [other for other, until in held.items() if other != name and loop.time() < until]
            assert not others, f"{name} holds the lock, and so does {others[0]}"
            held[name] = asked + LEASE
        await asyncio.sleep(pause)


async def two_hold_one_lock(fleet: GuardedFleet, faults: Faults) -> None:
    async with faults.on(fleet, at="post", split=0.05, seconds=(10.0, 30.0), times=1):
        for _ in range(2):
            fleet.start(give_locks)
        held: dict[str, float] = {}
        clients = [hold(fleet.servers(), held, name, times=8, pause=2.0) for name in ("ann", "bob")]
        await asyncio.gather(*clients)
