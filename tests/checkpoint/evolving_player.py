"""A root with a SQLite store whose code is given, for `test_evolving.py`: python evolving_player.py CODE STORE WHAT."""

from __future__ import annotations

import asyncio
import importlib.util
import os
import signal
import sys
from typing import Any

import holdfast as hf


def load(path: str) -> Any:
    spec = importlib.util.spec_from_file_location("evolving", path)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules["evolving"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


async def main(code: str, store: str, what: str) -> None:
    module = load(code)
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False) as system:
        for name, kind in getattr(module, "PLAIN", {}).items():
            await system.start(hf.child(name, hf.start(kind)))
        actor = await system.start(hf.child("a", hf.start(module.A), recovery=hf.hybrid(interval=1000.0)))
        if what != "read":
            for number in range(1, 6):
                await actor.ask(module.Add(number, 7), timeout=60.0)
                if what == "saved" and number == 3:
                    await system.checkpoint(actor)
            if what == "stopped":  # In good order: all is in the last snapshot.
                return
            os.kill(os.getpid(), signal.SIGKILL)
        sys.stdout.write(str(await actor.ask(module.Get(), timeout=60.0)))


if __name__ == "__main__":
    try:
        asyncio.run(main(*sys.argv[1:]))
    except hf.StartFailed as error:
        sys.exit(str(error))
