"""A root with a SQLite store for `test_safe_state_lives.py`: python safe_state_player.py STORE PLACE ORDER LIFE.

LIFE "killed": the planner is being recovered when the process ends by SIGKILL. LIFE "last": what the wheels were told
in all is printed, when no recovery is under way. ORDER: who is started first, and who when it is up.
"""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from typing import Any

import holdfast as hf
from tests.checkpoint.guards import Planner, Wheels, over, running, words
from tests.checkpoint.players import until
from tests.checkpoint.strikes import NEVER, strike
from tests.checkpoint.test_safe_state_lives import PLACES


async def main(store: str, place: str, order: str, life: str) -> None:
    recovering = asyncio.Event()

    async def wait(step: hf.checkpoint.RecoveryStep) -> None:
        if life == "killed" and step.address == "/app/planner":
            recovering.set()
            await asyncio.Event().wait()

    hooks = hf.checkpoint.recovery_hooks(before={"release": wait}, timeout=300.0)
    method = hf.hybrid(interval=NEVER, safe_state="/app/wheels")
    planner = hf.child("planner", hf.start(Planner), recovery=method)
    specs = {"wheels": hf.child("wheels", hf.start(Wheels), **PLACES[place]), "planner": planner}
    async with running(f"sqlite:{store}", recovery_hooks=hooks) as system:
        starting: list[asyncio.Future[Any]] = []
        for name in order.split(","):
            starting.append(asyncio.ensure_future(system.start(specs[name])))
            if life == "last" or name == "wheels":
                await starting[-1]
        if life == "killed":
            waiting: asyncio.Future[Any] = asyncio.ensure_future(recovering.wait())
            all_up: asyncio.Future[Any] = asyncio.gather(*starting)
            await asyncio.wait([waiting, all_up], return_when=asyncio.FIRST_COMPLETED)
            if not recovering.is_set():  # It was not being recovered when this program began.
                strike(system, system.ref("/app/planner", hf.Actor))
            await recovering.wait()
            assert (await words(system.ref("/app/wheels", Wheels)))[-1:] == ["safe"]
            await system._homes.settled()
            os.kill(os.getpid(), signal.SIGKILL)
        await over(system)
        await until(lambda: not system._homes.recoveries.safety._receivers)
        print(" ".join(await words(system.ref("/app/wheels", Wheels))))


if __name__ == "__main__":
    hf.run(main(*sys.argv[1:]))
