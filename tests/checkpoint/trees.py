"""Recorded children below a supervisor, in all three ways, and with both stores."""

from __future__ import annotations

import os
import signal
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import holdfast as hf
from tests.checkpoint.players import Do, Doer, Seen, until
from tests.checkpoint.strikes import NEVER


@asynccontextmanager
async def running(store: str | None) -> AsyncGenerator[hf.ActorSystem, None]:
    async with hf.ActorSystem("app", store=store, log=False, intensity=1000) as system:
        yield system


def doing(isolation: str, name: str = "doer", **options: Any) -> hf.ChildSpec:
    """A recorded child for a `tree` of this isolation."""
    method: dict[str, Any] = {"interval": NEVER}
    method.update({key: options.pop(key) for key in ("keep", "on_escalate") if key in options})
    own: Any = "process" if isolation == "process" else "task"
    options = {"shutdown": 8.0, **options}
    return hf.child(name, hf.start(Doer), isolation=own, recovery=hf.hybrid(**method), **options)


def tree(isolation: str, *children: hf.ChildSpec, **options: Any) -> hf.ChildSpec:
    own: Any = "process" if isolation == "subtree" else "task"
    flags: dict[str, Any] = {"intensity": 100, **options}
    return hf.supervisor("top", children=children, isolation=own, **flags)


def at(system: hf.ActorSystem, name: str = "doer") -> hf.ActorRef[Doer]:
    return system.ref(f"/app/top/{name}", Doer)


def top(system: hf.ActorSystem) -> hf.ActorRef[hf.Supervisor]:
    return system.ref("/app/top", hf.Supervisor)


async def seen(system: hf.ActorSystem, name: str = "doer") -> list[str]:
    await until(lambda: f"/app/top/{name}" in system.tree())
    ref: hf.ActorRef[Any] = system.ref(f"/app/top/{name}", hf.Actor)
    return await ref.ask(Seen(), timeout=20.0)


async def add(system: hf.ActorSystem, *words: str, name: str = "doer") -> None:
    for word in words:
        await at(system, name).ask(Do([f"add {word}"]), timeout=20.0)


async def back(stream: hf.events.EventStream, kind: Any = hf.events.Recovered, address: str = "/app/top/doer") -> Any:
    """Wait for what is told of an address."""
    async for event in stream:
        if isinstance(event, kind) and event.address == address:
            return event
    raise AssertionError(kind)


async def snapshot(system: hf.ActorSystem, name: str = "doer") -> None:
    """Have the actor save its state now, in good order: stopped and started again by hand."""
    await top(system).ask(hf.TerminateChild(name), timeout=20.0)
    await top(system).ask(hf.RestartChild(name), timeout=20.0)


async def escalate(system: hf.ActorSystem, isolation: str) -> None:
    """Crash the child of a supervisor that allows no restart, and wait until both are back."""
    with system.events() as stream:
        with_crash = at(system).ask(Do(["raise it"]), timeout=20.0)
        try:
            await with_crash
        except hf.RemoteCrash:
            pass
        await back(stream, hf.events.ChildRestarted, "/app/top")
    await until(lambda: "/app/top/doer" in system.tree() and at(system)._cell.host.is_up(at(system)._cell))


def end_process(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
    pid = system.pid_of(ref)
    assert pid != os.getpid()
    os.kill(pid, signal.SIGKILL)


def store_at(path: Path, kind: str) -> str | None:
    return None if kind == "memory" else f"sqlite:{path / 'app.db'}"
