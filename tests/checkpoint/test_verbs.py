"""What an actor may do at which moment: the table in docs/recovery/verbs.md, cell by cell, over crashes (DESIGN 6)."""

from __future__ import annotations

import asyncio
import os
import re
import sys
from pathlib import Path
from typing import Any

import pytest

import holdfast
import holdfast as hf
from tests.checkpoint.players import Note, Notes, Sink, start, until
from tests.checkpoint.strikes import NEVER, home, strike

pytestmark = [pytest.mark.pairs, pytest.mark.usefixtures("warm_programs")]

FIRST, RESTORED, TURN, RECOVERED, STOPPED = "on_start(False)", "on_start(True)", "turn", "on_recovered", "on_stop"


# The root of the package may be its folder under another name, so the way to it is told.
ROOTS = str(Path(holdfast.__file__).parents[1]), str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH")
PATHS = os.pathsep.join(filter(None, ROOTS))


class Act(hf.Message[int]): ...


class Tick(hf.Message):
    text: str


class Heard(hf.Message[list[str]]): ...


class End(hf.Message): ...


class Peer(hf.Actor):
    @hf.on(End)
    def end(self, message: End) -> None:
        self.ctx.stop(hf.Crash("Bang", "it ends"))


async def work() -> str:
    return "piped"


class Acting(hf.Actor):
    """Does all that can be done, at the moments it is told."""

    def __init__(self, moments: list[str]) -> None:
        self.heard: list[str] = []
        self.timers: list[Any] = []
        self._moments = moments

    def on_start(self, restored: bool) -> None:
        self._at(f"on_start({restored})")

    def on_recovered(self) -> None:
        self._at(RECOVERED)

    def on_stop(self, reason: hf.ExitReason) -> None:
        if reason.is_clean:
            self._at(STOPPED)

    @hf.on(Act)
    def act(self, message: Act) -> int:
        self._at(TURN)
        return len(self.heard)

    def _at(self, moment: str) -> None:
        if moment not in self._moments:
            return
        ctx = self.ctx
        ctx.find("/app/notes", Sink).tell(Note(moment))
        self.timers = [ctx.every(NEVER, Tick("every")), ctx.tell_after(NEVER, Tick("after"))]
        ctx.every(NEVER, Tick("never")).cancel()
        ctx.subscribe("/topic")
        ctx.subscribe("/other")
        ctx.unsubscribe("/other")
        ctx.monitor(ctx.find("/app/monitored", Peer))
        ctx.watch(ctx.find("/app/watched", Peer))
        ctx.link(ctx.find("/app/linked", Peer))
        ctx.monitor(ctx.find("/app/untied", Peer)).cancel()
        ctx.link(ctx.find("/app/untied", Peer))
        ctx.unlink(ctx.find("/app/untied", Peer))
        ctx.trap_exits = True
        ctx.pipe_to_self(work(), Tick)
        ctx.spawn(hf.start(Sink))

    @hf.on(Tick)
    def tick(self, message: Tick) -> None:
        self.heard.append(message.text)

    @hf.on(Note)
    def note(self, message: Note) -> int:
        self.heard.append(message.text)
        return len(self.heard)

    @hf.on(Heard, readonly=True)
    def read(self, message: Heard) -> list[str]:
        return list(self.heard)

    def on_down(self, source: hf.ActorRef[Any], reason: hf.ExitReason, recovering: bool) -> None:
        self.heard.append(f"DOWN {source.path}")

    def on_exit(self, source: hf.ActorRef[Any], reason: hf.ExitReason) -> None:
        self.heard.append(f"EXIT {source.path}")


def method(name: str) -> hf.Method:
    made: hf.Method = getattr(hf, name)(**({} if name == "replay_only" else {"interval": NEVER}))
    return made


async def peers(system: hf.ActorSystem) -> hf.ActorRef[Sink]:
    for name in ("monitored", "watched", "linked", "untied"):
        await system.start(hf.child(name, hf.start(Peer), restart="temporary"))
    return await system.start(hf.child("notes", hf.start(Sink)))


async def acting(system: hf.ActorSystem, isolation: str, name: str, *moments: str) -> hf.ActorRef[Acting]:
    recipe = hf.start(Acting, list(moments))
    return await start(system, isolation, "acting", recipe, recovery=method(name), shutdown=8.0)


async def stands(system: hf.ActorSystem, ref: hf.ActorRef[Acting], piped: int) -> None:
    """All that was done is in force, once."""
    timers = sorted((interval > 0, body[-5:]) for _, body, _, interval in home(ref).timers.saved().values())
    assert timers == [(False, b"after"), (True, b"every")], home(ref).timers.saved()
    await heard(ref, "piped", piped)
    before = (await ref.ask(Heard(), timeout=30.0)).count("news")
    await system.publish("/topic", Note("news"))
    await system.publish("/other", Note("other"))
    await heard(ref, "news", before + 1)


async def struck(system: hf.ActorSystem, ref: hf.ActorRef[Acting]) -> None:
    """Strike, and wait for the next life."""
    life = ref._cell.life
    strike(system, ref)
    await until(lambda: ref._cell.life > life and ref._cell.host.is_up(ref._cell))


async def heard(ref: hf.ActorRef[Acting], text: str, times: int) -> None:
    async with asyncio.timeout(30.0):
        while (found := await ref.ask(Heard(), timeout=30.0)).count(text) < times:
            await asyncio.sleep(0)
    assert found.count(text) == times, found
    assert "other" not in found


async def told_of_the_ends(system: hf.ActorSystem, ref: hf.ActorRef[Acting]) -> None:
    """Each of those that are tied to it is heard of once, and the one that is not, not at all."""
    for name in ("untied", "linked", "watched", "monitored"):
        peer = system.ref(f"/app/{name}", Peer)
        peer.tell(End())
    wanted = {"DOWN /app/monitored", "DOWN /app/watched", "EXIT /app/linked"}
    found: list[str] = []
    async with asyncio.timeout(30.0):
        while not wanted <= set(found):
            found = await ref.ask(Heard(), timeout=30.0)
    assert sorted(one for one in found if one[:5] in ("DOWN ", "EXIT ")) == sorted(wanted)


async def snapshot(system: hf.ActorSystem, ref: hf.ActorRef[Acting]) -> None:
    if home(ref).method.snapshots:
        await system.checkpoint(ref, timeout=30.0)


@pytest.mark.parametrize("name", ["hybrid", "replay_only", "checkpoint_only"])
async def test_what_on_start_does_is_in_force_once_after_each_crash(name: str, isolation: str, store: str) -> None:
    """Restored or not, before the first snapshot and behind it."""
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        notes = await peers(system)
        ref = await acting(system, isolation, name, FIRST, RESTORED)
        starts, restored = 1, 0
        await stands(system, ref, 1)
        await struck(system, ref)  # No snapshot yet.
        forgets = name == "checkpoint_only"
        starts += forgets
        await stands(system, ref, 1)
        await snapshot(system, ref)
        for _ in range(2):  # The second time from the same state.
            await struck(system, ref)
            restored += name != "replay_only"
            await stands(system, ref, 1 if name == "replay_only" else 2 if forgets else 1 + restored)
        assert await notes.ask(Notes()) == [FIRST] * starts + [RESTORED] * restored
        await told_of_the_ends(system, ref)


@pytest.mark.parametrize("name", ["hybrid", "replay_only", "checkpoint_only"])
async def test_what_a_turn_does_is_in_force_once_after_each_crash(name: str, isolation: str, store: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        notes = await peers(system)
        ref = await acting(system, isolation, name, TURN)
        await ref.ask(Act(), timeout=30.0)
        await stands(system, ref, 1)
        if name == "checkpoint_only":
            await snapshot(system, ref)
        await struck(system, ref)
        await stands(system, ref, 1)
        await snapshot(system, ref)
        await struck(system, ref)
        await stands(system, ref, 1)
        assert await notes.ask(Notes()) == [TURN]
        await told_of_the_ends(system, ref)


@pytest.mark.parametrize(
    ("name", "moment"),
    [
        ("hybrid", RECOVERED),
        ("replay_only", RECOVERED),
        ("checkpoint_only", RECOVERED),
        ("hybrid", RESTORED),
        ("checkpoint_only", RESTORED),
    ],
)
async def test_what_only_a_later_life_does_is_in_force_once_after_each_crash(
    name: str, moment: str, isolation: str, store: str
) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        notes = await peers(system)
        ref = await acting(system, isolation, name, moment)
        await ref.ask(Act(), timeout=30.0)
        await snapshot(system, ref)
        for recovered in (1, 2):
            await struck(system, ref)
            await stands(system, ref, 1 if name == "checkpoint_only" else recovered)
            assert await notes.ask(Notes()) == [moment] * recovered
        await told_of_the_ends(system, ref)


@pytest.mark.parametrize("end", ["stopped", "killed"])
@pytest.mark.parametrize("moments", [[FIRST, RESTORED], [TURN]], ids=", ".join)
@pytest.mark.parametrize("name", ["hybrid", "replay_only", "checkpoint_only"])
@pytest.mark.some(6)
async def test_it_goes_on_over_a_restart_of_the_root(
    name: str, moments: list[str], end: str, isolation: str, tmp_path: Path
) -> None:
    store = tmp_path / "app.db"
    command = [sys.executable, "-m", "tests.checkpoint.verbs_player", str(store), isolation, name, end, *moments]
    first = await asyncio.create_subprocess_exec(*command, env={**os.environ, "PYTHONPATH": PATHS})
    assert await first.wait() == (-9 if end == "killed" else 0)
    async with hf.ActorSystem("app", log=False, store=f"sqlite:{store}") as system:
        await peers(system)
        ref = await acting(system, isolation, name, *moments)
        is_restored = name != "replay_only" and RESTORED in moments
        await stands(system, ref, 1 + is_restored)
        await told_of_the_ends(system, ref)


async def test_what_on_stop_does_is_in_force_when_it_comes_back(isolation: str, store: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        notes = await peers(system)
        ref = await acting(system, isolation, "hybrid", STOPPED)
        above = "/app" if isolation != "subtree" else "/app/of-acting"
        await ref.ask(Act(), timeout=30.0)
        top = system.ref(above, hf.Supervisor)
        await top.ask(hf.TerminateChild("acting"), timeout=30.0)
        assert await notes.ask(Notes()) == [STOPPED]
        await top.ask(hf.RestartChild("acting"), timeout=30.0)
        timers = sorted((interval > 0, body[-5:]) for _, body, _, interval in home(ref).timers.saved().values())
        assert timers == [(False, b"after"), (True, b"every")]
        await system.publish("/topic", Note("news"))
        await heard(ref, "news", 1)


def forbidden(ctx: Any, ref: hf.ActorRef[Any]) -> dict[str, Any]:
    """What neither `__init__` nor a background task may do. (What `__init__` sends comes from nobody.)"""
    return {
        "tell": lambda: ctx._tell(ref._cell, Act()),
        "ask": lambda: ctx._ask(ref._cell, Act(), 1.0),
        "kill": lambda: ctx._order(ref._cell, "kill"),
        "every": lambda: ctx.every(NEVER, Tick("x")),
        "tell_after": lambda: ctx.tell_after(NEVER, Tick("x")),
        "subscribe": lambda: ctx.subscribe("/x"),
        "unsubscribe": lambda: ctx.unsubscribe("/x"),
        "monitor": lambda: ctx.monitor(ref),
        "watch": lambda: ctx.watch(ref),
        "link": lambda: ctx.link(ref),
        "unlink": lambda: ctx.unlink(ref),
        "pipe_to_self": lambda: ctx.pipe_to_self(asyncio.get_running_loop().create_future(), Tick),
        "unstash": lambda: ctx.unstash(),
    }


def refused(ctx: Any) -> list[str]:
    found = []
    for name, verb in forbidden(ctx, ctx.ref).items():
        try:
            verb()
        except hf.HoldfastError as error:
            found.append(f"{name}: {error}")
    return found


class Forward(hf.Actor):
    """Tries at the wrong moments."""

    def __init__(self) -> None:
        self.in_init = refused(self.ctx)
        self.in_background: list[str] = []

    async def on_start(self, restored: bool) -> None:
        task = self.ctx.create_task(self._background())  # While the hook still runs.
        await task

    async def on_recovered(self) -> None:
        await self.ctx.create_task(self._background())

    @hf.on(Tick)
    def tick(self, message: Tick) -> None:
        self.in_background.append(message.text)

    async def _background(self) -> None:
        self.in_background += refused(self.ctx)

    @hf.on(Act)
    async def act(self, message: Act) -> int:
        await self.ctx.create_task(self._background())
        return len(self.in_background)

    @hf.on(Heard, readonly=True)
    def read(self, message: Heard) -> list[str]:
        return [*self.in_init, *self.in_background]


async def test_what_is_refused_is_refused_with_its_reason(isolation: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        ref = await start(system, isolation, "acting", hf.start(Forward), recovery=method("hybrid"))
        await system.checkpoint(ref, timeout=30.0)
        await struck(system, ref)  # on_start(True) and on_recovered have a background task, too.
        await ref.ask(Act(), timeout=30.0)
        told = await ref.ask(Heard(), timeout=30.0)
    names = list(forbidden(None, ref))
    assert [one.partition(":")[0] for one in told] == names * 5
    assert [one for one in told[: len(names)] if "act in on_start" not in one] == []
    assert all("report with ctx.pipe_to_self" in one for one in told[len(names) :])


class Keeper(hf.Actor):
    """Keeps a promise and puts messages aside until it is recovered."""

    def __init__(self) -> None:
        self.heard: list[str] = []
        self.handles: list[hf.ReplyHandle[int]] = []
        self.is_open = False

    def on_start(self, restored: bool) -> None:
        if restored and not self.is_open:
            self.is_open = True
            self.ctx.unstash()
            for handle in self.handles:
                handle.reply(7)
            self.handles.clear()

    @hf.on(Act)
    def act(self, message: Act) -> Any:
        handle = self.ctx.reply_handle()
        self.handles.append(handle)
        return handle

    @hf.on(Note)
    def note(self, message: Note) -> int:
        if not self.is_open:
            self.ctx.stash()
        else:
            self.heard.append(message.text)
        return len(self.heard)

    @hf.on(Heard, readonly=True)
    def read(self, message: Heard) -> list[str]:
        return list(self.heard)


async def test_what_was_promised_and_put_aside_is_taken_up_in_on_start(isolation: str, store: str) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        ref = await start(system, isolation, "keeper", hf.start(Keeper), recovery=method("hybrid"))
        promised = ref.ask(Act(), timeout=60.0)
        for text in ("one", "two"):
            ref.tell(Note(text))
        await ref.ask(Heard(), timeout=30.0)
        await system.checkpoint(ref, timeout=30.0)
        for _ in range(2):
            await struck(system, ref)
            assert await promised == 7
            async with asyncio.timeout(30.0):
                while await ref.ask(Heard(), timeout=30.0) != ["one", "two"]:
                    await asyncio.sleep(0)


def test_each_public_name_has_its_row() -> None:
    """Whatever `self.ctx`, a ref or a handle can do stands in the table."""
    page = (Path(__file__).parents[2] / "docs/recovery/verbs.md").read_text()
    table = page.partition("## The table")[2].partition("The words in the cells mean")[0]
    rows = (line.split("|")[1] for line in table.splitlines() if line.startswith("| `"))
    told = {name.removeprefix("ref.") for row in rows for name in re.findall("`(.*?)`", row)}
    kinds = (hf.ActorContext, hf.ActorRef, hf.Timer, hf.Monitor, hf.ReplyHandle)
    names = {name for kind in kinds for name in vars(kind) if not name.startswith("_")}
    assert names == told - {"self.ctx"}
