"""What a member that registers at its start holds: the same in all its lives, whatever its recovery method is."""

from __future__ import annotations

import asyncio
import contextlib
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.testing import idle
from tests.supervision.registry_player import METHODS, End, Enter, Hits, Leave, Member, Names, found, house

pytestmark = pytest.mark.usefixtures("warm_programs")

ROOT = Path(__file__).parents[2]
RECORDED = [name for name in METHODS if name != "plain"]
MEMBER = [("member", 7)]


async def another_life(system: hf.ActorSystem, life: tuple[Any, int]) -> None:
    async with asyncio.timeout(60.0):
        while True:
            with contextlib.suppress(hf.errors.NoSuchActor):
                cell = system.ref("/app/house/member")._cell
                if (cell, cell.life) != life and cell.host.is_up(cell):
                    return
            await asyncio.sleep(0.005)


@pytest.mark.parametrize("how", ["registry", "member", "both", "snapshot"])
@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("keys", ["unique", "duplicate"])
async def test_a_member_is_in_once_whoever_is_restarted(keys: str, method: str, isolation: str, how: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=100) as system:
        await system.start(house(keys, method, isolation=isolation))
        assert await found(system) == MEMBER
        member = system.ref("/app/house/member", Member)
        if how == "snapshot" and method not in ("plain", "replay_only"):
            await system.checkpoint(member, timeout=60.0)
        target = {"registry": "/app/house/names", "both": "/app/house"}.get(how, "/app/house/member")
        life = member._cell, member._cell.life
        system.ref(target).kill()
        await another_life(system, life)
        await system.ref("/app/house/member", Member).ask(Hits(), timeout=60.0)
        assert await found(system) == MEMBER


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("keys", ["unique", "duplicate"])
def test_a_member_is_in_once_after_a_kill_of_the_program(tmp_path: Path, keys: str, method: str) -> None:
    command = [sys.executable, "-m", "tests.supervision.registry_player", f"sqlite:{tmp_path / 'app.db'}", keys, method]
    for run, code in (("first", -9), ("first", -9), ("next", 0), ("next", 0)):
        done = subprocess.run([*command, run], capture_output=True, text=True, cwd=ROOT)
        assert (done.returncode, done.stdout) == (code, f"{MEMBER}\n"), done.stderr


async def open_house(system: hf.ActorSystem, method: str = "hybrid", keys: str = "unique") -> hf.ActorRef[Member]:
    await system.start(house(keys, method, enters=False))
    return system.ref("/app/house/member", Member)


async def start_again(system: hf.ActorSystem) -> None:
    top = system.ref("/app/house", hf.Supervisor)
    await top.ask(hf.TerminateChild("member"), timeout=60.0)
    assert await found(system, "k") == []
    await top.ask(hf.RestartChild("member"), timeout=60.0)


class Heard(hf.Message[list[str]]): ...


class Listener(hf.Actor):
    def __init__(self) -> None:
        self.heard: list[str] = []

    @hf.on(hf.supervision.KeyRegistered)
    def came(self, message: hf.supervision.KeyRegistered) -> None:
        self.heard.append("came")

    @hf.on(hf.supervision.KeyFreed)
    def went(self, message: hf.supervision.KeyFreed) -> None:
        self.heard.append("went" if message.ended else "left")

    @hf.on(Heard)
    def read(self, message: Heard) -> list[str]:
        return self.heard


@pytest.mark.parametrize("method", RECORDED)
async def test_it_has_what_it_had_when_it_is_started_again(method: str) -> None:
    """Also the last value, and not what it has given up."""
    async with hf.ActorSystem("app", log=False, intensity=100) as system:
        member = await open_house(system, method)
        for key, value in (("k", 1), ("gone", 2), ("k", 3)):
            await member.ask(Enter(key, value))
        await member.ask(Leave("gone"))
        await start_again(system)
        assert await found(system, "k") == [("member", 3)]
        assert await found(system, "gone") == []


@pytest.mark.parametrize("method", RECORDED)
async def test_it_has_what_it_had_when_it_has_ended_by_itself(method: str) -> None:
    """Who listens hears that it has gone, and that it has come back."""
    async with hf.ActorSystem("app", log=False, intensity=100) as system:
        member = await open_house(system, method)
        listener = await system.start(hf.child("listener", hf.start(Listener)))
        await member.ask(Enter("k", 1))
        life = member._cell, member._cell.life
        member.tell(End())
        await another_life(system, life)
        await idle(system)
        assert await found(system, "k") == [("member", 1)]
        assert await listener.ask(Heard()) == ["came", "went", "came"]


async def test_a_recorded_actor_has_one_entry_for_a_key() -> None:
    async with hf.ActorSystem("app", log=False, intensity=100) as system:
        member = await open_house(system, keys="duplicate")
        for value in (1, 2):
            await member.ask(Enter("k", value))
        assert await found(system, "k") == [("member", 2)]


async def test_a_key_that_another_one_has_taken_meanwhile_stays_with_that() -> None:
    async with hf.ActorSystem("app", log=False, intensity=100) as system:
        member = await open_house(system)
        await member.ask(Enter("k", 1))
        await system.ref("/app/house", hf.Supervisor).ask(hf.TerminateChild("member"))
        other = await system.start(hf.child("other", hf.start(Member, False)))
        await other.ask(Enter("k", 2))
        await system.ref("/app/house", hf.Supervisor).ask(hf.RestartChild("member"))
        assert await found(system, "k") == [("other", 2)]


@pytest.mark.parametrize("how", ["fresh", "deleted"])
async def test_who_begins_with_nothing_holds_nothing(how: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=100) as system:
        member = await open_house(system)
        await member.ask(Enter("k", 1))
        top = system.ref("/app/house", hf.Supervisor)
        await top.ask(hf.TerminateChild("member"))
        if how == "fresh":
            await top.ask(hf.RestartChild("member", fresh=True))
        else:
            await top.ask(hf.DeleteChild("member"))
            await top.ask(hf.StartChild(hf.child("member", hf.start(Member, False), recovery=METHODS["hybrid"])))
        await idle(system)
        assert await found(system, "k") == []


async def test_what_it_holds_moves_with_it(tmp_path: Path) -> None:
    store: Any = f"sqlite:{tmp_path / 'app.db'}"
    for is_first in (True, False):
        async with hf.ActorSystem("app", log=False, store=store) as system:
            if is_first:
                member = await open_house(system)
                await system.start(hf.supervisor("attic"))
                await member.ask(Enter("k", 1))
                async with system.transaction() as change:
                    change.move(member, "/app/attic")
            else:
                names = hf.supervision.registry("names")
                await system.start(hf.supervisor("house", children=[names]))
                spec = hf.child("member", hf.start(Member, False), recovery=METHODS["hybrid"])
                await system.start(hf.supervisor("attic", children=[spec]))
            entries = await Names(system.ref("/app/house/names", hf.supervision.RegistryActor)).lookup("k")
            assert [entry.holder.path for entry in entries] == ["/app/attic/member"]
