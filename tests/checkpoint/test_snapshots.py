"""Snapshots of a large state: when they are taken, what is written, and that it comes back (T9, T10, T18).

The checkpoint handler (R15) saves at intervals (R21), outside the actor (R20), and restores a new life (R36).
"""

from __future__ import annotations

import asyncio
import contextlib
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import holdfast as hf
from holdfast.checkpoint.snapshot.state_image import LARGE, Imager, read_image
from holdfast.checkpoint.sqlite import SqliteJournal
from tests.checkpoint.image_player import CELLS, MANY, Canvas, Digest, Paint, Spoil, Write
from tests.checkpoint.players import start, until
from tests.checkpoint.strikes import NEVER, event, strike

HANDLER = "/app/recovery/checkpoints"


async def canvas(system: hf.ActorSystem, isolation: str, *arguments: Any, **options: Any) -> hf.ActorRef[Canvas]:
    options.setdefault("interval", NEVER)
    return await start(
        system, isolation, "canvas", hf.start(Canvas, *arguments), recovery=hf.hybrid(**options), shutdown=8.0
    )


def handler(system: hf.ActorSystem) -> Any:
    """Whoever is the checkpoint handler now."""
    return system._node.find(HANDLER)


async def taken(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> hf.events.SnapshotTaken:
    with system.events() as stream:
        await system.checkpoint(ref, timeout=20.0)
        return await event(stream, hf.events.SnapshotTaken)


def running(store: str | None) -> hf.ActorSystem:
    return hf.ActorSystem("app", store=store, log=False, intensity=1000)


@pytest.mark.pairs
@pytest.mark.parametrize("cells", [600_000, MANY])
async def test_what_has_not_changed_is_not_written_again_and_all_of_it_comes_back(
    store: str | None, isolation: str, cells: int
) -> None:
    async with running(store) as system:
        ref = await canvas(system, isolation, cells)
        await ref.ask(Paint(0, cells))
        whole = await taken(system, ref)
        assert whole.written_bytes == whole.size_bytes > cells * 8
        await ref.ask(Paint(cells // 2, cells // 10))
        tenth = await taken(system, ref)
        assert tenth.size_bytes == whole.size_bytes
        assert cells * 8 // 10 <= tenth.written_bytes <= cells * 8 // 10 + 3 * 256 * 1024
        await ref.ask(Write("x"))
        small = await taken(system, ref)
        assert small.written_bytes < 2000, "only the small variables have changed"
        await ref.ask(Paint(7, 1))
        before = await ref.ask(Digest())
        with system.events() as stream:
            strike(system, ref)
            recovered = await event(stream, hf.events.Recovered)
        assert await ref.ask(Digest(), timeout=20.0) == before
        assert recovered.replayed == 1, "what no snapshot has: a change; the look is left out"


def shared_bytes() -> int:
    """How much memory without a name this process shares with others, each piece counted once."""
    pieces: dict[int, int] = {}
    for entry in os.scandir("/proc/self/fd"):
        with contextlib.suppress(FileNotFoundError):  # It is that of the folder itself.
            if os.readlink(entry.path).startswith("/memfd:"):
                about = os.stat(entry.path)
                pieces[about.st_ino] = about.st_blocks * 512
    return sum(pieces.values())


async def test_memory_that_no_snapshot_needs_is_given_back(system: hf.ActorSystem, isolation: str) -> None:
    ref = await canvas(system, isolation)
    for _ in range(4):  # What never changes stays in the first segment.
        await ref.ask(Paint(0, CELLS))
        await system.checkpoint(ref, timeout=20.0)
    grid, fixed = CELLS * 8, CELLS // 4 * 8
    assert shared_bytes() < 2 * grid + fixed + grid // 2, "that of the newest snapshot and of one older"


async def test_a_snapshot_is_in_the_store_when_checkpoint_returns(store: str | None, isolation: str) -> None:
    if store is None:
        pytest.skip("nothing outlives the root in memory")
    async with running(store) as system:
        ref = await canvas(system, isolation)
        await ref.ask(Paint(3, 5))
        await system.checkpoint(ref, timeout=20.0)
        switch: Any = ref._cell.host.home.switch  # type: ignore[attr-defined]
        saved = system._homes.journal.load(ref.path)
        assert saved.turn == switch.turn
        assert not saved.entries
        before = await ref.ask(Digest())
    async with running(store) as system:
        ref = await canvas(system, isolation)
        assert await ref.ask(Digest(), timeout=20.0) == before


async def test_a_snapshot_is_taken_every_so_many_messages(system: hf.ActorSystem, isolation: str) -> None:
    ref = await canvas(system, isolation, 10, every=20)
    with system.events() as stream:
        for _ in range(19):
            await ref.ask(Write("x"))
        assert not [one for one in stream.take() if isinstance(one, hf.events.SnapshotTaken)]
        await ref.ask(Write("x"))
        first = await event(stream, hf.events.SnapshotTaken)
        assert 19 <= first.turn <= 21


async def test_a_snapshot_is_taken_after_so_many_bytes_of_journal(system: hf.ActorSystem, isolation: str) -> None:
    ref = await canvas(system, isolation, 10, journal_bytes=50_000)
    with system.events() as stream:
        for _ in range(4):
            await ref.ask(Write("x" * 10_000))
        assert not [one for one in stream.take() if isinstance(one, hf.events.SnapshotTaken)]
        for _ in range(3):
            await ref.ask(Write("x" * 10_000))
        await event(stream, hf.events.SnapshotTaken)


async def test_a_snapshot_is_taken_when_the_interval_is_over_and_only_of_what_has_changed(
    system: hf.ActorSystem, isolation: str
) -> None:
    ref = await canvas(system, isolation, 10, interval=0.05)
    await ref.ask(Write("x"))
    with system.events() as stream:
        await event(stream, hf.events.SnapshotTaken)
        await asyncio.sleep(0.3)  # There is nothing to wait for: nothing shall happen.
        assert not [one for one in stream.take() if isinstance(one, hf.events.SnapshotTaken)]


async def test_whoever_wants_a_snapshot_gets_it_however_often_the_handler_dies(
    system: hf.ActorSystem, isolation: str
) -> None:
    ref = await canvas(system, isolation)
    for number in range(12):
        await ref.ask(Paint(number, 1))
        wish = asyncio.ensure_future(system.checkpoint(ref, timeout=20.0))
        for _ in range(number % 4):
            await asyncio.sleep(0)
        handler(system).kill()
        await wish
    assert await ref.ask(Paint(0, 1)) == 13


async def test_the_interval_goes_on_with_the_next_handler(system: hf.ActorSystem) -> None:
    ref = await canvas(system, "task", 10, interval=0.05)
    await until(lambda: handler(system) is not None)  # Recovery parts start beside the program.
    first = handler(system)
    first.kill()
    await until(lambda: handler(system).life > 1)
    await ref.ask(Write("x"))
    with system.events() as stream:
        await event(stream, hf.events.SnapshotTaken)


async def test_what_cannot_be_saved_is_told_tried_again_and_nothing_is_lost(
    system: hf.ActorSystem, isolation: str
) -> None:
    ref = await canvas(system, isolation, 3_000_000, interval=0.05)
    await system.checkpoint(ref, timeout=20.0)
    await ref.ask(Spoil(True))
    with system.events() as stream:
        failed = await event(stream, hf.events.SnapshotFailed)
        assert "spoiled" in failed.reason
        again = await event(stream, hf.events.SnapshotFailed)
        assert again.reason == failed.reason
    with pytest.raises(hf.errors.CheckpointFailed, match="spoiled"):
        await system.checkpoint(ref, timeout=20.0)
    await ref.ask(Spoil(False))
    await system.checkpoint(ref, timeout=20.0)
    assert (await taken_after(system, ref)).written_bytes < 300_000, "the images before it are still good"


async def taken_after(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> hf.events.SnapshotTaken:
    await ref.ask(Write("x"))
    return await taken(system, ref)


async def test_an_unrecorded_actor_cannot_be_saved(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("plain", hf.start(Canvas, 10)))
    with pytest.raises(hf.SpecError, match="keeps no snapshots"):
        await system.checkpoint(ref)


def test_variables_that_share_something_come_back_sharing_it() -> None:
    inner = [1, 2]
    array = np.arange(30_000)
    state = {"a": inner, "b": {"x": inner}, "c": array, "d": [array], "e": 5, "f": [1, 2]}
    pieces = Imager().image(3, "keys", state, "x")
    version, form, back = read_image(b"".join(bytes(memoryview(piece).cast("B")) for _, piece in pieces))
    assert (version, form) == (3, "keys")
    assert isinstance(back, dict)
    assert back["b"]["x"] is back["a"]
    assert back["d"][0] is back["c"]
    assert back["f"] is not back["a"]
    assert {name: back[name] for name in "abef"} == {name: state[name] for name in "abef"}
    assert (back["c"] == array).all()


@pytest.mark.parametrize("other", [[], [np.zeros(3)]], ids=["alike", "unlike"])
def test_buffers_lie_where_they_lay_when_one_more_has_come(other: list[Any]) -> None:
    photos = [*other, *(np.full(2000 + number, number, np.uint8) for number in range(100))]
    before = dict(Imager().image(0, "keys", {"photos": photos}, "/map"))
    photos.append(np.ones(2000, np.uint8))
    after = dict(Imager().image(0, "keys", {"photos": photos}, "/map"))
    assert len(bytes(before["photos", 2])) > LARGE
    assert bytes(after["photos", 2]).startswith(bytes(before["photos", 2]))


def test_an_image_with_any_byte_of_its_head_damaged_is_refused_or_reads_the_same_arrays() -> None:
    pieces = Imager().image(1, "keys", {"n": 1, "grid": np.ones(20_000)}, "x")
    data = b"".join(bytes(memoryview(piece).cast("B")) for _, piece in pieces)
    for size in (0, 5, 9, 30, len(data) - 1):
        with pytest.raises(hf.HoldfastError):
            read_image(data[:size])


class LostStore(SqliteJournal):
    """Another program has come to own it."""

    is_lost = False

    def cut(self, address: str, snapshot: bytes, drop: Any, *, turn: int, keep: int = 2) -> None:
        if self.is_lost:
            raise hf.errors.StaleEpoch(self.path, epoch=1, current=2)
        super().cut(address, snapshot, drop, turn=turn, keep=keep)

    def has_failed(self) -> bool:
        return self.is_lost


async def test_a_store_that_was_lost_is_not_told_of_by_each_snapshot(tmp_path: Path) -> None:
    store = LostStore(str(tmp_path / "app.db"))
    async with hf.ActorSystem("app", store=store, log=False) as system:
        ref = await canvas(system, "task", 100)
        with system.events() as stream:
            store.is_lost = True
            with pytest.raises(hf.errors.CheckpointFailed, match="another opening owns it"):
                await system.checkpoint(ref, timeout=20.0)
            assert not any(isinstance(one, hf.events.SnapshotFailed) for one in stream.take())
        store.is_lost = False
