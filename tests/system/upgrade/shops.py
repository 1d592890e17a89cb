"""A program with a store, newer versions of it, and the commands that handle its recorded turns again."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from holdfast.console.commands import commands

PATHS = os.pathsep.join(filter(None, sys.path))
SHOP = """
import asyncio
import os
import signal
import sys
from pathlib import Path

import holdfast as hf

DONE = Path(os.environ["DONE"])


class Pay(hf.Message[int]):
    cents: int
    memo: str = ""


class Note(hf.Message):
    text: str


class Rate(hf.Message[int]): ...


class Book(hf.Message): ...


class Go(hf.Message): ...


class Came(hf.Message):
    text: str


def done(what: str) -> str:
    with DONE.open("a") as file:
        file.write(what + "\\n")
    return what


async def slow(what: str) -> str:
    done(what)
    await asyncio.sleep(3600.0)
    return what


def emptied(state):
    return {**state, "balance": 0}


class Ledger(hf.Actor):
    def __init__(self) -> None:
        self.lines: list[str] = []

    @hf.on(Note)
    def note(self, message: Note) -> None:
        self.lines.append(message.text)

    @hf.on(Rate, readonly=True)
    def rate(self, message: Rate) -> int:
        return 1


class Account(hf.Actor):
    def __init__(self, balance: int = 0) -> None:
        self.balance = balance
        self.memos: list[str] = []
        self.ledger: hf.ActorRef[Ledger] | None = None

    def on_start(self, restored: bool) -> None:
        if restored:
            self.ctx.find("/app/ledger", Ledger).tell(Note("back"))
            self.ctx.pipe_to_self(slow("begun by a hook"), Came)
            self.ctx.every(0.01, Came("a tick"))

    @hf.on(Came)
    def came(self, message: Came) -> None: ...

    @hf.on(Pay)
    async def pay(self, message: Pay) -> int:
        ledger = self.ctx.find("/app/ledger", Ledger)
        self.balance += message.cents - await ledger.ask(Rate())
        self.memos.append(message.memo)
        self.ledger = ledger
        ledger.tell(Note(message.memo))
        return self.balance


class Trip(hf.Actor):
    def __init__(self) -> None:
        self.seen: list[str] = []

    def on_start(self, restored: bool) -> None:
        self.ctx.find("/app/ledger", Ledger).tell(Note("trip"))

    @hf.on(Book)
    async def book(self, message: Book) -> None:
        self.seen.append(await self.ctx.effect(done, "seat"))
        self.ctx.pipe_to_self(slow("begun by a turn"), Came)
        self.ctx.tell_after(3600.0, Go())
        await self.ctx.wait_for(Go)
        self.seen.append("gone")

    @hf.on(Go)
    def go(self, message: Go) -> None: ...

    @hf.on(Came)
    def came(self, message: Came) -> None: ...


class Search(hf.Actor):
    @hf.on(Book)
    def book(self, message: Book) -> None:
        self.ctx.pipe_to_self(slow("searched"), Came)

    @hf.on(Came)
    def came(self, message: Came) -> None: ...


SLOW = hf.hybrid(interval=1000.0)
tree = [
    hf.child("ledger", hf.start(Ledger), recovery=hf.replay_only()),
    hf.supervisor("bank", children=[hf.child("alice", hf.start(Account, 100), isolation="process", recovery=SLOW)]),
    hf.child("trip", hf.start(Trip), recovery=SLOW),
    hf.child("search", hf.start(Search), recovery=SLOW),
    hf.dynamic("rooms", journal=True),
]


async def main(store: str, what: str) -> None:
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False) as system:
        for one in tree:
            await system.start(one)
        alice, trip = system.ref("/app/bank/alice", Account), system.ref("/app/trip", Trip)
        rooms = system.ref("/app/rooms", hf.Actor)
        await rooms.ask(hf.StartChild(hf.child("one", hf.start(Ledger), recovery=SLOW)))
        system.ref("/app/rooms/one", Ledger).tell(Note("a room"))
        for number in range(1, int(os.environ.get("TURNS", "8")) + 1):
            await alice.ask(Pay(10 * number, f"m{number}"), timeout=60.0)
            if number in (3, 6):
                await system.checkpoint(alice)
            elif number == 7 and what == "waits":
                await system.replace_state(alice, emptied)
        system.ref("/app/search", Search).tell(Book())
        trip.tell(Book())
        switches = system._homes._switches
        while not switches["/app/trip"].calls.rests.is_busy or "searched" not in DONE.read_text():
            await asyncio.sleep(0.01)
        await system._homes.settled()
        if what == "killed":
            os.kill(os.getpid(), signal.SIGKILL)
        print("up", flush=True)
        await asyncio.to_thread(sys.stdin.readline)
        print(await alice.ask(Pay(1)), flush=True)


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
"""
SESSIONS = """
import asyncio

import holdfast as hf


class Leave(hf.Message[str]): ...


class Session(hf.Actor):
    def __init__(self, name: str = "nobody") -> None:
        self.name = name
        self.left = 0

    @hf.on(Leave)
    def leave(self, message: Leave) -> str:
        self.left += 1
        self.ctx.stop()
        return 'bye'


LASTS = hf.replay_only()
session = hf.child(None, hf.start(Session), recovery=LASTS, restart="transient")
tree = [
    hf.dynamic("rooms", journal=True),
    hf.dynamic("sleeping", template=session, journal=True),
]


async def main(store: str) -> None:
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False) as system:
        for one in tree:
            above = await system.start(one)
            given = {"id": "ann"}
            if one.id != "sleeping":
                given = {"spec": hf.child("ann", hf.start(Session, "ann"), recovery=LASTS, restart="transient")}
            session = await above.ask(hf.StartChild(**given))
            await session.ask(Leave())
            while session.path in system.tree():
                await asyncio.sleep(0.01)
"""
RUN = "import asyncio, sys, shop; asyncio.run(shop.main(*sys.argv[1:]))"


def environment(folder: Path, **more: str) -> dict[str, str]:
    return {
        **os.environ,
        "PYTHONPATH": PATHS,
        "PYTHONDONTWRITEBYTECODE": "1",
        "DONE": str(folder / "done"),
        **more,
    }


def begin(folder: Path, what: str, *, script: bool = False, **more: str) -> subprocess.Popen[str]:
    """Start the program in a folder of its own."""
    folder.mkdir(exist_ok=True)
    (folder / "shop.py").write_text(SHOP)
    (folder / "done").touch()
    call = ["shop.py"] if script else ["-c", RUN]
    return subprocess.Popen(
        [sys.executable, *call, str(folder / "app.db"), what],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=folder,
        env=environment(folder, **more),
    )


def killed(folder: Path, *, script: bool = False, **more: str) -> Path:
    """The store of a program that was killed."""
    with begin(folder, "killed", script=script, **more) as process:
        assert process.wait(60.0) == -signal.SIGKILL
    return folder / "app.db"


def newer(folder: Path, *changes: tuple[str, str]) -> Path:
    """A folder with another version of the program."""
    folder.mkdir(exist_ok=True)
    code = SHOP
    for old, new in changes:
        assert old in code
        code = code.replace(old, new)
    (folder / "shop.py").write_text(code)
    return folder


def check(
    monkeypatch: pytest.MonkeyPatch, store: Path, code: Path, *arguments: str, spec: str = "shop:tree"
) -> tuple[int, dict[str, Any], str]:
    """Run `holdfast check-upgrade` where the newer program is; its status, what it printed by address, and errors."""
    monkeypatch.chdir(code)
    monkeypatch.setenv("DONE", str(store.parent / "done"))
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    result = CliRunner().invoke(commands, ["check-upgrade", str(store), spec, "--json", *arguments])
    found: dict[str, Any] = {}
    if result.stdout:
        found = {one["address"]: one for one in json.loads(result.stdout)["addresses"]}
    return result.exit_code, found, result.stderr


def replay(store: Path, code: Path, *arguments: str, keys: str = "") -> tuple[int, str, str]:
    """Run `holdfast replay` in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-m", "holdfast.console.cli", "replay", str(store), *arguments],
        capture_output=True,
        text=True,
        input=keys,
        cwd=code,
        env=environment(store.parent),
        timeout=60.0,
    )
    return done.returncode, done.stdout, done.stderr
