"""Large lists and dicts in actors: snapshots by chunks, crashes at any moment, and what is read back (R25, R26, T9)."""

from __future__ import annotations

import asyncio
import os
import random
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import holdfast
import holdfast as hf
from holdfast.checkpoint.snapshot import image_writer
from holdfast.checkpoint.store_tools import compact_store, export_store, verify_store
from tests.checkpoint.ledger_player import FORKED, MANY, Book, Change, Ledger, Told, Turns, told
from tests.checkpoint.players import start
from tests.checkpoint.strikes import NEVER, strike

pytestmark = pytest.mark.usefixtures("warm_programs")

SEED = 20_261_127
FEW = 8
"""Segments that an image may be spread over, so that little has to be saved until they are gathered."""
SCRIPT = Path(__file__).with_name("ledger_root.py")
PATHS = os.pathsep.join(
    filter(None, (str(Path(holdfast.__file__).parents[1]), str(SCRIPT.parents[2]), os.environ.get("PYTHONPATH")))
)


async def ledger(system: hf.ActorSystem, where: str, room: int = 0, count: int = MANY) -> hf.ActorRef[Ledger]:
    recovery = hf.hybrid(interval=NEVER, max_deliveries=1000)
    return await start(system, where, "ledger", hf.start(Ledger, count, room), recovery=recovery, shutdown=8.0)


async def changed(ref: hf.ActorRef[Ledger], want: Book, dice: random.Random) -> None:
    change = Change(dice.randrange(10**9))
    want.change(change.seed)
    await ref.ask(change, timeout=25.0)


async def taken(system: hf.ActorSystem, ref: hf.ActorRef[Ledger]) -> hf.events.SnapshotTaken:
    with system.events() as stream:
        await system.checkpoint(ref, timeout=25.0)
        return [one for one in stream.take() if isinstance(one, hf.events.SnapshotTaken)][-1]


def running(store: str | None) -> hf.ActorSystem:
    return hf.ActorSystem("app", store=store, log=False, intensity=10_000)


@pytest.mark.pairs
@pytest.mark.parametrize("room", [0, FORKED])
@pytest.mark.some(3)
async def test_what_little_has_changed_is_written_and_all_comes_back(
    store: str | None, isolation: str, room: int
) -> None:
    print(f"seed {SEED}")
    dice, want = random.Random(SEED), Book(MANY)
    async with running(store) as system:
        ref = await ledger(system, isolation, room)
        for _ in range(2):  # The first one is saved as one value, unless it has so much room.
            await changed(ref, want, dice)
            await taken(system, ref)
        for number in range(3):
            for _ in range(3):
                for _ in range(2):
                    await changed(ref, want, dice)
                    want.other = None
                one = await taken(system, ref)
                assert one.size_bytes > 1024 * 1024 + room
            await changed(ref, want, dice)
            with system.events() as stream:
                strike(system, ref)
                assert await ref.ask(Told(), timeout=25.0) == told(want), f"seed {SEED}, life {number}"
                await system.checkpoint(ref, timeout=25.0)
                written = [one.written_bytes for one in stream.take() if isinstance(one, hf.events.SnapshotTaken)]
            if number == 0:  # Later a store may have so much that is not needed that all is written anew.
                assert sum(written) < 600_000, "what has come back is not written again"


@pytest.mark.parametrize("where", ["task", "process"])
@pytest.mark.some(2)
async def test_a_life_ends_in_the_middle_of_a_snapshot(store: str | None, where: str) -> None:
    print(f"seed {SEED}")
    dice, want = random.Random(SEED), Book(MANY)
    async with running(store) as system:
        ref = await ledger(system, where, FORKED if where == "process" else 0)
        for number in range(4):
            await changed(ref, want, dice)
            wish = asyncio.ensure_future(system.checkpoint(ref, timeout=25.0))
            await asyncio.sleep(dice.choice((0.0, dice.uniform(0.0, 0.2))))
            change = Change(dice.randrange(10**9))
            want.change(change.seed)
            ref.tell(change)
            strike(system, ref)
            assert await ref.ask(Told(), timeout=25.0) == told(want), f"seed {SEED}, round {number}"
            await asyncio.wait([wish])
            wish.exception()


async def test_an_image_that_could_not_be_kept_is_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The chunks of the lost one are not taken for kept."""
    dice, want = random.Random(SEED), Book(MANY)
    async with running(f"sqlite:{tmp_path / 'app.db'}") as system:
        ref = await ledger(system, "task")
        for _ in range(3):
            await changed(ref, want, dice)
            await taken(system, ref)

        def refuse(*_: Any) -> None:
            raise OSError("the disk is full")

        with monkeypatch.context() as patched:
            patched.setattr(type(system._homes.journal), "keep_blocks", refuse)
            for _ in range(2):
                await changed(ref, want, dice)
                with pytest.raises(hf.errors.CheckpointFailed, match="the disk is full"):
                    await system.checkpoint(ref, timeout=25.0)
        await taken(system, ref)
        strike(system, ref)
        assert await ref.ask(Told(), timeout=25.0) == told(want)


async def test_a_state_that_is_saved_often_is_never_written_as_a_whole_again(
    store: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is scattered over many snapshots is gathered; what most of the state is in stays where it is."""
    monkeypatch.setattr(image_writer, "MOST_SEGMENTS", FEW)
    want = Book(2 * MANY)
    async with running(store) as system:
        ref = await ledger(system, "task", count=2 * MANY)
        for _ in range(2):
            want.change(0, "append")
            await ref.ask(Change(0, "append"), timeout=25.0)
            await taken(system, ref)
        for seed in range(2 * FEW):
            want.change(seed, "replace")
            await ref.ask(Change(seed, "replace"), timeout=25.0)
            one = await taken(system, ref)
            assert one.written_bytes < one.size_bytes / 2
        strike(system, ref)
        assert await ref.ask(Told(), timeout=25.0) == told(want)


async def test_the_older_snapshot_is_whole(store: str | None) -> None:
    dice, want = random.Random(SEED), Book(MANY)
    async with running(store) as system:
        recovery = hf.hybrid(interval=NEVER, on_escalate="older_snapshot")
        spec = hf.child("ledger", hf.start(Ledger, MANY), recovery=recovery)
        await system.start(hf.supervisor("top", children=[spec], intensity=0))
        ref = system.ref("/app/top/ledger", Ledger)
        for _ in range(3):
            await changed(ref, want, dice)
            await taken(system, ref)
        await ref.ask(Change(5), timeout=25.0)
        await taken(system, ref)
        with system.events() as stream:
            ref.kill()
            async for event in stream:
                if isinstance(event, hf.events.RolledBack):
                    break
        assert await ref.ask(Told(), timeout=25.0) == told(want)


@pytest.mark.parametrize("where", ["task", "process"])
def test_the_root_dies_in_the_middle_of_a_snapshot(tmp_path: Path, where: str) -> None:
    moments = random.Random(SEED)
    print(f"seed {SEED}")
    store, following = tmp_path / "app.db", 0
    for _ in range(2):
        fatal = following + moments.randint(3, 30)
        root = begin(store, where, following, 1_000_000)
        assert root.stdout is not None
        with root.stdout as out:
            for line in out:
                if int(line) == fatal:
                    root.kill()
        assert root.wait() == -9, f"seed {SEED}: it ended by itself"
        following = asyncio.run(count(store, where))
    done = Book(MANY)
    for n in range(following):
        done.change(n)
    root = begin(store, where, 1, 0)
    output, _ = root.communicate(timeout=60)
    assert output.splitlines()[-1] == told(done).hex(), f"seed {SEED}"


async def count(store: Path, where: Any) -> int:
    """How many changes were made: the next one goes on from there, whether or not the last was answered."""
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False) as system:
        spec = hf.child("ledger", hf.start(Ledger), isolation=where, recovery=hf.hybrid(interval=NEVER))
        ref = await system.start(spec)
        return await ref.ask(Turns(), timeout=60.0)


def begin(store: Path, where: str, first: int, last: int) -> subprocess.Popen[str]:
    command = [sys.executable, str(SCRIPT), str(store), where, str(first), str(last)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": PATHS})


@pytest.mark.parametrize("key", [None, bytes(range(32))])
async def test_the_tools_read_what_is_stored_by_chunks(tmp_path: Path, key: bytes | None) -> None:
    dice, want, path = random.Random(SEED), Book(MANY), tmp_path / "app.db"
    async with hf.ActorSystem("app", store=f"sqlite:{path}.live", store_key=key, log=False) as system:
        ref = await ledger(system, "task")
        for _ in range(6):
            await changed(ref, want, dice)
            await taken(system, ref)
        await system.backup(path)
    assert verify_store(path, key=key).is_good
    (first, *_) = [one for one in export_store(path, key=key) if one["record"] == "snapshot"][::-1]
    variables = first["variables"]
    assert len(variables["book.log"]) == len(want.log)
    orders = variables["book.orders"]
    assert len(orders.get("pairs", orders)) == len(want.orders)
    assert [one["fields"]["number"] for one in variables["book.open"]] == [one.number for one in want.open]
    compact_store(path, key=key)
    async with hf.ActorSystem("app", store=f"sqlite:{path}", store_key=key, log=False) as system:
        ref = await ledger(system, "task")
        assert await ref.ask(Told(), timeout=25.0) == told(want)
