"""Through how many files does a call go?

Traces one operation in the program's own process and prints, as one JSON line each, how many files of the library it
enters. Fewer files are fewer places to read for whoever follows a message.

Each operation is done several times before it is traced, so that nothing is imported or set up for the first time, and
then traced several times, without garbage collection. What is entered each time counts: what belongs to a timer that
was set before, or comes now and then (a process that is replaced in the reserve), is not part of it. Threads that run
already are not traced, nor are other processes.

    walk                  what was done
    files                 how many files of the library were entered each time
    now_and_then          how many more were entered at least once

Command: python benchmarks/walks.py [-v] [--only TEXT]      -v prints which files, in order of their first call
"""

from __future__ import annotations

import argparse
import asyncio
import gc
import json
import os
import signal
import sys
import threading
from collections.abc import Awaitable, Callable, Generator
from contextlib import contextmanager
from contextvars import Context, ContextVar
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

from workload import Ping, Responder, Tick

import holdfast as hf

PACKAGE = f"{Path(hf.__file__).parent}{os.sep}"
BESIDE = tuple(PACKAGE + name + os.sep for name in ("tests", "benchmarks", "examples", ".venv"))
WARM_UPS, RUNS = 3, 5
IN_WALK: ContextVar[None] = ContextVar("IN_WALK")
RUNS_HANDLE = asyncio.Handle._run.__code__


def context_of(handle: Any) -> Context:
    """What a handle is run in: that of whoever has made it, which asyncio keeps to itself."""
    context: Context = handle._context
    return context


def is_of_walk(frame: FrameType) -> bool:
    """Whether a call is no part of an import, nor of a timer that was set before the walk began."""
    above: FrameType | None = frame
    while above is not None:
        code = above.f_code
        if code.co_filename.startswith("<frozen importlib"):
            return False
        if code is RUNS_HANDLE:
            handle = above.f_locals["self"]
            return not isinstance(handle, asyncio.TimerHandle) or IN_WALK in context_of(handle)
        above = above.f_back
    return True


@contextmanager
def traced() -> Generator[list[str]]:
    """Note each file of the library that is entered meanwhile, in this thread or a new one."""
    entered: dict[str, None] = {}

    def enter(frame: FrameType, event: str, _: Any) -> None:
        name = frame.f_code.co_filename
        if event == "call" and name.startswith(PACKAGE) and not name.startswith(BESIDE):
            name = name.removeprefix(PACKAGE)
            if name not in entered and is_of_walk(frame):
                entered[name] = None

    names: list[str] = []
    gc.collect()
    gc.disable()
    token = IN_WALK.set(None)
    threading.setprofile(enter)
    sys.setprofile(enter)
    try:
        yield names
    finally:
        sys.setprofile(None)
        threading.setprofile(None)  # None takes it back, as the documentation says.
        IN_WALK.reset(token)
        gc.enable()
        names += entered


class Hearer(hf.Actor):
    """Says that it has heard."""

    def __init__(self, heard: Callable[[], None]) -> None:
        self._heard = heard

    @hf.on(Tick)
    def hear(self, message: Tick) -> None:
        """Say so."""
        self._heard()


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


Step = Callable[[], Awaitable[object]]


async def nothing() -> None:
    """There is nothing to be undone before the operation can be done again."""


class Walk(NamedTuple):
    """An operation, and what has to be done before it can be done again."""

    go: Step
    back: Step = nothing


async def local_tell(system: hf.ActorSystem) -> Walk:
    """A tell to an actor of this loop, until it is handled."""
    done: list[asyncio.Future[None]] = []
    ref = system.spawn(hf.start(Hearer, lambda: done[-1].set_result(None)))

    async def tell() -> None:
        done.append(asyncio.get_running_loop().create_future())
        ref.tell(Tick())
        await done[-1]

    return Walk(tell)


async def ask_to_a_process(system: hf.ActorSystem) -> Walk:
    """An ask to an actor in a process, until its reply is here."""
    ref = await system.start(hf.child("far", hf.start(Responder), isolation="process"))
    return Walk(lambda: ref.ask(Ping()))


async def recorded_message(system: hf.ActorSystem) -> Walk:
    """An ask to a recorded actor, from its admission to its reply."""
    ref = await system.start(hf.child("kept", hf.start(Recorded), recovery=hf.hybrid()))
    return Walk(lambda: ref.ask(Fill()))


async def kill_to_released(system: hf.ActorSystem) -> Walk:
    """SIGKILL to the process of a recorded actor, until it has answered again."""
    ref = await system.start(hf.child("killed", hf.start(Recorded), recovery=hf.hybrid(), isolation="process"))
    pids = [system.pid_of(ref)]

    async def kill() -> None:
        os.kill(pids[-1], signal.SIGKILL)
        await ref.ask(Fill(), timeout=60.0)

    async def rest() -> None:
        """Let the reserve of processes be filled again."""
        await asyncio.sleep(1.0)
        pids.append(system.pid_of(ref))

    return Walk(kill, rest)


async def protect(system: hf.ActorSystem) -> Walk:
    """A mechanism is put before a recorded actor."""
    ref = await system.start(hf.child("guarded", hf.start(Recorded), recovery=hf.hybrid()))
    await ref.ask(Fill())

    def protected(mechanism: hf.ftm.PBR | None) -> Step:
        async def change() -> None:
            async with system.transaction(timeout=60.0) as changes:
                changes.protect(ref, mechanism)

        return change

    return Walk(protected(hf.ftm.PBR()), protected(None))


async def migrate(system: hf.ActorSystem) -> Walk:
    """A recorded actor goes from a task into a process of its own."""
    ref = await system.start(hf.child("moved", hf.start(Recorded), recovery=hf.hybrid()))
    await ref.ask(Fill())
    return Walk(lambda: system.set_isolation(ref, "process"), lambda: system.set_isolation(ref, "task"))


async def protected_ask(system: hf.ActorSystem) -> Walk:
    """An ask to an actor behind PBR, until its reply is here."""
    ref = await system.start(hf.child("doubled", hf.start(Recorded), mechanism=hf.ftm.PBR()))
    return Walk(lambda: ref.ask(Fill()))


async def failover(system: hf.ActorSystem) -> Walk:
    """SIGKILL to the process of a primary, until the other replica has answered."""
    ref = await system.start(hf.child("doubled", hf.start(Recorded), mechanism=hf.ftm.PBR()))

    async def kill() -> None:
        os.kill(pids[-1], signal.SIGKILL)
        await ref.ask(Fill(), timeout=60.0)

    async def rest() -> None:
        """Let the new replica catch up, and find the one that leads now."""
        await asyncio.sleep(2.0)
        pids.append(await primary())

    async def primary() -> int:
        leader = (await system.protection(ref)).leader
        return system.pid_of(system.ref(f"{ref.path}/ftm/{leader}", hf.Actor))

    pids = [await primary()]
    return Walk(kill, rest)


async def transaction(system: hf.ActorSystem) -> Walk:
    """A child is added and a binding made in one step."""
    ref = await system.start(hf.supervisor("desk", children=[hf.child("kept", hf.start(Recorded))]))
    spec = hf.child("added", hf.start(Recorded))

    async def add() -> None:
        async with system.transaction() as change:
            change.add(ref, spec)

    async def remove() -> None:
        async with system.transaction() as change:
            change.remove(system.ref(f"{ref.path}/added", Recorded))

    return Walk(add, remove)


WALKS: dict[str, Callable[[hf.ActorSystem], Awaitable[Walk]]] = {
    "local tell": local_tell,
    "ask to a process": ask_to_a_process,
    "recorded message to its reply": recorded_message,
    "SIGKILL to released": kill_to_released,
    "move from a task to a process": migrate,
    "ask behind PBR": protected_ask,
    "SIGKILL of a primary to the next reply": failover,
    "transaction": transaction,
    "protect": protect,
}


async def entered_by(walk: Walk) -> tuple[list[str], set[str]]:
    """The files that are entered each time, in order, and those that are entered at least once."""
    for _ in range(WARM_UPS):
        await walk.go()
        await walk.back()
    runs: list[list[str]] = []
    for _ in range(RUNS):
        with traced() as names:
            await walk.go()
        runs.append(names)
        await walk.back()
    return [name for name in runs[0] if all(name in run for run in runs)], {name for run in runs for name in run}


async def take_walks(only: str, *, is_verbose: bool) -> None:
    """Each walk in a system of its own."""
    for name, prepare in WALKS.items():
        if only in name:
            async with hf.ActorSystem("walk", log=False, intensity=1000) as system:
                each_time, once = await entered_by(await prepare(system))
            print(json.dumps({"walk": name, "files": len(each_time), "now_and_then": len(once) - len(each_time)}))
            if is_verbose:
                print(*(f"    {one}" for one in each_time), sep="\n")
                print(*(f"    now and then: {one}" for one in sorted(once - {*each_time})), sep="\n", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-v", "--verbose", action="store_true", help="print which files")
    parser.add_argument("--only", default="", metavar="TEXT", help="only walks with TEXT in their name")
    arguments = parser.parse_args()
    asyncio.run(take_walks(arguments.only, is_verbose=arguments.verbose))
