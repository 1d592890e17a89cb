"""A root with a SQLite store and a large state whose process dies again and again, for `test_large_states.py`.

It says on stdout how often the state was painted; it is killed in the middle of a recovery.
"""

from __future__ import annotations

import os
import signal
import sys

import holdfast as hf
from tests.checkpoint.image_player import MANY, Canvas, Paint, Turns


async def main(store: str) -> None:
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False, intensity=1000) as system:
        recovery = hf.hybrid(interval=3600.0, max_deliveries=1000)
        ref = await system.start(hf.child("canvas", hf.start(Canvas, MANY), isolation="process", recovery=recovery))
        for n in range(await ref.ask(Turns(), timeout=60.0), 1000):
            await ref.ask(Paint(n * 37 % MANY, 40_000), timeout=60.0)
            if n % 3 == 0:
                await system.checkpoint(ref, timeout=60.0)
            sys.stdout.write(f"{n}\n")
            sys.stdout.flush()
            os.kill(system.pid_of(ref), signal.SIGKILL)


if __name__ == "__main__":
    hf.run(main(sys.argv[1]))
