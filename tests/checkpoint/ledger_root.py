"""A root with a SQLite store and large lists and dicts, run by `test_chunks_kept.py` with STORE WHERE FIRST LAST.

It changes them and says on stdout which changes were accepted; it is killed in the middle of it. With FIRST > LAST it
only says what is there.
"""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from typing import Any

import holdfast as hf
from tests.checkpoint.ledger_player import Change, Ledger, Told


async def main(store: str, isolation: Any, first: int, last: int) -> None:
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False, intensity=100) as system:
        spec = hf.child("ledger", hf.start(Ledger), isolation=isolation, recovery=hf.hybrid(interval=0.02))
        ref = await system.start(spec)
        for n in range(first, last + 1):
            await ref.ask(Change(n), timeout=60.0)
            sys.stdout.write(f"{n}\n")
            sys.stdout.flush()
            await asyncio.sleep(0.003)
        sys.stdout.write((await ref.ask(Told(), timeout=60.0)).hex() + "\n")
        sys.stdout.flush()
        if last < first:  # Not a second long snapshot at the end.
            os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":
    hf.run(main(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])))
