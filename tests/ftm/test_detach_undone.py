"""A detach that is undone because its time is over leaves a group that works on, whatever it has waited for."""

from __future__ import annotations

import asyncio
import os
import signal
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.mechanisms.pbr import PBR
from tests.ftm.accounts import Add, Counter, Load, Tags
from tests.ftm.test_failover import group_of, other, pid_of, two_again
from tests.ftm.test_subtree import at, bank
from tests.ftm.test_subtree_changes import detach, names_of

PROMISED, GIVEN = 7, 1_000_000
RECOVERIES = {"plain": None, "recorded": hf.hybrid(interval=0.05)}


class Promise(hf.Message[int]):
    """Answered when somebody says `Give`."""


class Give(hf.Message[None]):
    tag: int = -1


class Fetch(hf.Message[int]):
    """Answered when background work is back, which lasts as long as there is a file; `owes`: else at once."""

    file: str
    owes: bool


class Linger(hf.Message[int]):
    """A turn that promises its reply, and lasts as long as there is a file."""

    file: str


class Owing(Counter):
    """Owes replies."""

    def __init__(self) -> None:
        super().__init__()
        self.handle: hf.ReplyHandle[int] | None = None

    @hf.on(Promise)
    def promise(self, message: Promise) -> Any:
        self.handle = self.ctx.reply_handle()
        return self.handle

    @hf.on(Give)
    def give(self, message: Give) -> None:
        handle, self.handle = self.handle, None
        if handle is not None:
            handle.reply(PROMISED)
        if message.tag >= 0:
            self.tags.append(message.tag)
            self.total += 1

    @hf.on(Fetch)
    def fetch(self, message: Fetch) -> Any:
        self.ctx.pipe_to_self(until_gone(Path(message.file)), lambda _: Give(GIVEN))
        return self.promise(Promise()) if message.owes else PROMISED

    @hf.on(Linger)
    async def linger(self, message: Linger) -> Any:
        reply = self.promise(Promise())
        await until_gone(Path(message.file))
        return reply


async def until_gone(path: Path) -> None:
    while path.exists():
        await asyncio.sleep(0.005)


async def start(system: hf.ActorSystem, place: str, recovery: str) -> hf.ActorRef[Any]:
    spec = hf.child("alice", hf.start(Owing), recovery=RECOVERIES[recovery], mechanism=PBR())
    if place == "here":
        return await system.start(spec)
    await system.start(bank(spec))
    return at(system, "alice")


def asked(what: str, file: Path) -> hf.Message[int]:
    """What leaves a detach something to wait for."""
    match what:
        case "work":
            return Fetch(str(file), owes=False)
        case "work, promised":
            return Fetch(str(file), owes=True)
        case _:
            return Linger(str(file))


async def renewed(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
    """Kill the replica that does not lead, and wait until its next life has caught up."""
    group = group_of(ref)
    name = other(group)
    life = group.membership.members[name]
    os.kill(pid_of(system, ref, name), signal.SIGKILL)
    async with asyncio.timeout(30):
        while group.membership.members.get(name, life) == life:
            await asyncio.sleep(0.005)
    await two_again(ref)


WAITED = [
    ("plain", "work", "not within"),
    ("plain", "work, promised", "not within"),
    ("plain", "turn, promised", "not within"),
    ("recorded", "work", "not within"),
    ("recorded", "work, promised", "not within"),
    ("recorded", "turn, promised", "not within"),
]


@pytest.mark.pairs
@pytest.mark.parametrize("place", ["here", "below a process"])
@pytest.mark.parametrize(("recovery", "what", "why"), WAITED)
async def test_the_stack_is_in_force_as_before(
    system: hf.ActorSystem, tmp_path: Path, recovery: str, what: str, why: str, place: str
) -> None:
    """While the reply is owed or the work is out, it answers, a replica that dies is replaced, and nothing is lost.

    When nothing is in the way any more it is detached.
    """
    file = tmp_path / "slow"
    file.touch()
    ref = await start(system, place, recovery)
    owed = asyncio.ensure_future(ref.ask(asked(what, file), timeout=60.0))
    in_turn = what == "turn, promised"
    load = Load(ref, clients=2)
    if not in_turn:
        await load.reached(5)
    with pytest.raises(hf.TransactionFailed, match=why) as failed:
        async with system.transaction(timeout=0.3) as change:
            change.protect(ref, None)
    assert failed.value.kept == ()
    assert names_of(ref) == ["pbr"]
    if not in_turn:
        await load.reached(5)
        await renewed(system, ref)
        await load.reached(5)
    file.unlink()
    if in_turn:
        ref.tell(Give())
    assert await owed == PROMISED
    await load.reached(5)
    await detach(system, ref)
    await load.reached(5)
    await load.stop()
    async with asyncio.timeout(30):
        while "work" in what and GIVEN not in await ref.ask(Tags()):
            await asyncio.sleep(0.005)
    tags = await ref.ask(Tags())
    assert len(tags) == len(set(tags))
    assert sorted(set(tags) - {GIVEN}) == list(range(load.sent))
    places = {tag: index + 1 for index, tag in enumerate(tags)}
    assert {tag: places[tag] for tag in load.answered} == load.answered
    assert not load.failed


async def test_a_replica_joins_while_a_detach_waits_for_work(system: hf.ActorSystem, tmp_path: Path) -> None:
    """Whoever asks a replica for its state keeps nobody else who has to tell it something waiting."""
    file = tmp_path / "slow"
    file.touch()
    ref = await start(system, "here", "plain")
    assert await ref.ask(Fetch(str(file), owes=False)) == PROMISED
    detaching = asyncio.ensure_future(detach(system, ref))
    async with asyncio.timeout(30):
        while not group_of(ref).delivery.is_stopping:
            await asyncio.sleep(0.005)
    await renewed(system, ref)
    assert not detaching.done()
    file.unlink()
    await detaching
    assert await ref.ask(Add(0)) >= 1
