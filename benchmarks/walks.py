"""Through how many files does a call go?

Traces one operation in the program's own process and prints, as one JSON line each, the files of the library that it
enters, in order of their first call. Fewer files are fewer places to read for whoever follows a message.

    walk                  what was done
    files                 how many files of the library were entered
    names                 which, in order

Command: python benchmarks/walks.py [--only TEXT]
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import signal
import sys
import threading
from collections.abc import Awaitable, Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from workload import Counter, Ping, Responder, Tick

import holdfast as hf

PACKAGE = f"{Path(hf.__file__).parent}{os.sep}"
BESIDE = tuple(PACKAGE + name + os.sep for name in ("tests", "benchmarks", "examples", ".venv"))


@contextmanager
def traced() -> Generator[list[str]]:
    """Note each file of the library that is entered meanwhile, in this thread or a new one."""
    entered: dict[str, None] = {}

    def enter(frame: FrameType, event: str, _: Any) -> None:
        name = frame.f_code.co_filename
        if event == "call" and name.startswith(PACKAGE) and not name.startswith(BESIDE):
            entered.setdefault(name.removeprefix(PACKAGE))

    names: list[str] = []
    threading.setprofile(enter)
    sys.setprofile(enter)
    try:
        yield names
    finally:
        sys.setprofile(None)
        threading.setprofile(None)  # None takes it back, as the documentation says.
        names += entered


class Fill(hf.Message[int]):
    """Answered behind a change of state, with a message sent on."""


class Recorded(hf.Actor):
    """Counts, and says so to whoever is bound."""

    def __init__(self) -> None:
        self.count = 0

    @hf.on(Fill)
    def fill(self, message: Fill) -> int:
        """Count."""
        self.count += 1
        return self.count


async def local_tell(system: hf.ActorSystem) -> list[str]:
    """A tell to an actor of this loop, until it is handled."""
    done = asyncio.get_running_loop().create_future()
    ref = system.spawn(hf.start(Counter, lambda: done.set_result(None), 2))
    ref.tell(Tick())
    await asyncio.sleep(0)
    with traced() as names:
        ref.tell(Tick())
        await done
    return names


async def ask_to_a_process(system: hf.ActorSystem) -> list[str]:
    """An ask to an actor in a process, until its reply is here."""
    ref = await system.start(hf.child("far", hf.start(Responder), isolation="process"))
    await ref.ask(Ping())
    with traced() as names:
        await ref.ask(Ping())
    return names


async def recorded_message(system: hf.ActorSystem) -> list[str]:
    """An ask to a recorded actor, from its admission to its reply."""
    ref = await system.start(hf.child("kept", hf.start(Recorded), recovery=hf.hybrid()))
    await ref.ask(Fill())
    with traced() as names:
        await ref.ask(Fill())
    return names


async def kill_to_released(system: hf.ActorSystem) -> list[str]:
    """SIGKILL to the process of a recorded actor, until it has answered again."""
    ref = await system.start(hf.child("killed", hf.start(Recorded), recovery=hf.hybrid(), isolation="process"))
    await ref.ask(Fill())
    pid = system.pid_of(ref)
    assert pid is not None
    with traced() as names:
        os.kill(pid, signal.SIGKILL)
        await ref.ask(Fill(), timeout=60.0)
    return names


async def protect(system: hf.ActorSystem) -> list[str]:
    """A mechanism is put before a recorded actor."""
    ref = await system.start(hf.child("guarded", hf.start(Recorded), recovery=hf.hybrid()))
    await ref.ask(Fill())
    with traced() as names:
        async with system.transaction(timeout=60.0) as change:
            change.attach(ref, hf.PBR())
    return names


WALKS: dict[str, Callable[[hf.ActorSystem], Awaitable[list[str]]]] = {
    "local tell": local_tell,
    "ask to a process": ask_to_a_process,
    "recorded message to its reply": recorded_message,
    "SIGKILL to released": kill_to_released,
    "protect": protect,
}


async def walk(only: str) -> None:
    """Each walk in a system of its own."""
    for name, steps in WALKS.items():
        if only in name:
            async with hf.ActorSystem("walk", log=False) as system:
                names = await steps(system)
            print(json.dumps({"walk": name, "files": len(names), "names": names}), flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", metavar="TEXT", help="only walks with TEXT in their name")
    asyncio.run(walk(parser.parse_args().only))
