"""Recorded actors to strike, and waiting for what follows."""

from __future__ import annotations

import asyncio
import os
import signal
from pathlib import Path
from typing import Any, TypeVar

import holdfast as hf
from holdfast.checkpoint.home.recorded_home import switch_of
from tests.checkpoint.players import Doer, Sink, start, until

E = TypeVar("E", bound=hf.events.Event)
NEVER = 3600.0


async def doer(system: hf.ActorSystem, isolation: Any, name: str = "doer", **options: Any) -> hf.ActorRef[Doer]:
    options.setdefault("interval", NEVER)
    return await start(system, isolation, name, hf.start(Doer), recovery=hf.hybrid(**options), shutdown=8.0)


async def sink(system: hf.ActorSystem) -> hf.ActorRef[Sink]:
    return await system.start(hf.child("sink", hf.start(Sink)))


def strike(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
    """End the life without warning: by SIGKILL from outside where there is a process to kill."""
    pid = system.pid_of(ref)
    if pid == os.getpid():
        ref.kill()
    else:
        os.kill(pid, signal.SIGKILL)


async def event(stream: hf.events.EventStream, kind: type[E]) -> E:
    async with asyncio.timeout(30.0):
        async for one in stream:
            if isinstance(one, kind):
                return one
    raise AssertionError(f"no {kind.__name__}")


async def struck(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> hf.events.Recovered:
    """Strike, and wait until it is back."""
    with system.events() as stream:
        strike(system, ref)
        return await event(stream, hf.events.Recovered)


def let_through(gate: Path) -> None:
    Path(f"{gate}.open").touch()


def place_of(ref: hf.ActorRef[Any]) -> Any:
    """Where its lives are lived."""
    return ref._cell.host.place


def home(ref: hf.ActorRef[Any]) -> Any:
    """Its home."""
    return switch_of(ref._cell)


def actor_of(ref: hf.ActorRef[Any]) -> Any:
    """The object itself, of an actor in this process."""
    return ref._cell.actor


async def snapshot_after(system: hf.ActorSystem, ref: hf.ActorRef[Any], turn: int) -> None:
    """Wait until a snapshot covers this turn."""
    switch = ref._cell.host.home.switch  # type: ignore[attr-defined]
    await until(lambda: switch.ledger.state_turn >= turn)
