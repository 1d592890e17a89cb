"""Damaged snapshots: an older one and the messages since, or a loud refusal; never a wrong state (T10, T11, T28)."""

from __future__ import annotations

import asyncio
import sqlite3
import threading
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import holdfast as hf
from holdfast.checkpoint.journal import StoreFailed
from holdfast.checkpoint.sqlite.engine import SqliteJournal
from tests.checkpoint.image_player import CELLS, Canvas, Digest, Paint, Spoil
from tests.checkpoint.strikes import NEVER


def running(path: Path) -> hf.ActorSystem:
    return hf.ActorSystem("app", store=f"sqlite:{path}", log=False)


async def begun(system: hf.ActorSystem, cells: int, **options: Any) -> hf.ActorRef[Canvas]:
    recovery = hf.hybrid(interval=NEVER, **options)
    return await system.start(hf.child("canvas", hf.start(Canvas, cells), recovery=recovery))


async def painted(path: Path, cells: int, snapshots: int, **options: Any) -> str:
    """A store with so many snapshots, the newest of which has a pack of its own; and a message that none has."""
    async with running(path) as system:
        ref = await begun(system, cells, **options)
        for number in range(snapshots):
            await ref.ask(Paint(number * 10, 5))
            await system.checkpoint(ref, timeout=20.0)
        await ref.ask(Paint(1, 3))
        await ref.ask(Spoil(True))  # No snapshot can be taken any more, at the end neither: as after a crash.
        return await ref.ask(Digest())


def packs(path: Path) -> list[Path]:
    """Oldest first."""
    return sorted(path.parent.glob("*-packs/*/*.pack"), key=lambda one: one.stat().st_mtime_ns)


def flip(file: Path, at: int) -> None:
    data = bytearray(file.read_bytes())
    data[at] ^= 0x41
    file.write_bytes(data)


@pytest.mark.parametrize(
    "where",
    ["magic", "offset", "length", "stored", "codec", "checksum", "first byte", "last byte", "cut", "missing", "empty"],
)
@pytest.mark.parametrize("compress", [False, True])
async def test_a_damaged_newest_pack_costs_nothing(tmp_path: Path, where: str, compress: bool) -> None:
    if compress:
        pytest.importorskip("zstandard")
    made = tmp_path / "made"
    made.mkdir()
    before = await painted(made / "app.db", CELLS, 3, compress=compress)
    store = made / "app.db"
    newest = packs(store)[-1]
    size = newest.stat().st_size
    places = {"magic": 0, "offset": 8, "length": 16, "stored": 20, "codec": 24, "checksum": 28, "first byte": 32}
    match where:
        case "cut":
            newest.write_bytes(newest.read_bytes()[: size // 2])
        case "missing":
            newest.unlink()
        case "empty":
            newest.write_bytes(b"")
        case _:
            flip(newest, places.get(where, size - 1))
    async with running(store) as system:
        with system.events() as stream:
            ref = await begun(system, CELLS, compress=compress)
            assert await ref.ask(Digest(), timeout=20.0) == before
            (said,) = [one for one in stream.take() if isinstance(one, hf.events.SnapshotDamaged)]
        assert "snapshot file" in said.reason
        assert said.address == ref.path


@pytest.mark.parametrize(("keep", "damaged", "is_good"), [(3, 2, True), (3, 3, False), (1, 1, False), (2, 1, True)])
async def test_as_many_as_are_kept_can_be_fallen_back_on(
    tmp_path: Path, keep: int, damaged: int, is_good: bool
) -> None:
    made = tmp_path / "made"
    made.mkdir()
    before = await painted(made / "app.db", 10, 5, keep=keep)
    store = made / "app.db"
    db = sqlite3.connect(store)
    ids = [number for (number,) in db.execute("SELECT id FROM snapshots ORDER BY id DESC")]
    assert len(ids) == keep
    for number in ids[:damaged]:
        db.execute("UPDATE snapshots SET data = zeroblob(length(data)) WHERE id = ?", (number,))
    db.commit()
    db.close()
    async with running(store) as system:
        if not is_good:
            with pytest.raises(hf.HoldfastError, match="no snapshot is left"):
                await begun(system, 10, keep=keep)
            return
        with system.events() as stream:
            ref = await begun(system, 10, keep=keep)
            assert await ref.ask(Digest()) == before
            assert [one for one in stream.take() if isinstance(one, hf.events.SnapshotDamaged)]


async def test_a_pack_that_all_snapshots_need_is_missed_loudly(tmp_path: Path) -> None:
    made = tmp_path / "made"
    made.mkdir()
    await painted(made / "app.db", CELLS, 3)
    store = made / "app.db"
    first = packs(store)[0]
    flip(first, first.stat().st_size - 100)
    async with running(store) as system:
        with pytest.raises(hf.HoldfastError, match="no snapshot is left"):
            await begun(system, CELLS)


async def test_a_compressed_state_comes_back_and_is_smaller(tmp_path: Path) -> None:
    pytest.importorskip("zstandard")
    sizes: dict[bool, int] = {}
    for compress in (False, True):
        folder = tmp_path / str(compress)
        folder.mkdir()
        before = await painted(folder / "app.db", CELLS, 2, compress=compress)
        store = folder / "app.db"
        sizes[compress] = sum(one.stat().st_size for one in packs(store))
        async with running(store) as system:
            ref = await begun(system, CELLS, compress=compress)
            assert await ref.ask(Digest(), timeout=20.0) == before
    assert sizes[True] < sizes[False] / 10


async def test_a_removal_that_comes_late_leaves_the_packs_of_the_snapshots_since(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The thread that removes packs may come to it when the next snapshot is kept already."""
    may_remove, remove = threading.Event(), SqliteJournal.forget_blocks

    def remove_late(self: SqliteJournal, address: str, numbers: Collection[int]) -> None:
        if threading.current_thread() is not threading.main_thread():
            assert may_remove.wait(20.0)
        remove(self, address, numbers)

    monkeypatch.setattr(SqliteJournal, "forget_blocks", remove_late)
    async with running(tmp_path / "app.db") as system:
        ref = await begun(system, CELLS)
        for number in range(4):
            await ref.ask(Paint(number * 10, 5))
            await system.checkpoint(ref, timeout=20.0)
        may_remove.set()
        await ref.ask(Spoil(True))
        before = await ref.ask(Digest())
    async with running(tmp_path / "app.db") as system:
        assert await (await begun(system, CELLS)).ask(Digest(), timeout=20.0) == before


class Sheet(hf.Actor):
    """All of it changes with each message, so that no snapshot needs a pack of those before it."""

    def __init__(self) -> None:
        self.grid = np.zeros(CELLS)

    @hf.on(Paint)
    def paint(self, message: Paint) -> int:
        self.grid += message.by
        return int(self.grid.sum()) // CELLS


@pytest.mark.parametrize("keep", [1, 2])
async def test_a_snapshot_that_could_not_be_kept_leaves_the_packs_of_those_before_it(
    tmp_path: Path, keep: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(self: SqliteJournal, *args: Any, **options: Any) -> None:
        raise StoreFailed("app.db", "the disk is full; nothing has happened")

    spec, store = hf.child("sheet", hf.start(Sheet), recovery=hf.hybrid(interval=NEVER, keep=keep)), tmp_path / "app.db"
    async with running(store) as system:
        ref = await system.start(spec)
        for _ in range(8):  # Now and then an image is written anew, and refers to no pack before it.
            await ref.ask(Paint(0, 0))
            await system.checkpoint(ref, timeout=20.0)
            await asyncio.gather(*saves())
            kept = packs(store)
            with monkeypatch.context() as full:
                full.setattr(SqliteJournal, "cut", refuse)
                await ref.ask(Paint(0, 0))
                with pytest.raises(hf.HoldfastError, match="the disk is full"):
                    await system.checkpoint(ref, timeout=20.0)
                await asyncio.gather(*saves())
            assert set(kept) <= set(packs(store))
    async with running(store) as system:
        assert await (await system.start(spec)).ask(Paint(0, 0), timeout=20.0) == 17


def saves() -> set[asyncio.Task[Any]]:
    """What keeps snapshots that are on their way, and removes what no snapshot needs any more."""
    return {one for one in asyncio.all_tasks() if one.get_name().startswith("snapshot of ")}


class Tear(hf.Message[None]): ...


class Brittle(Sheet):
    @hf.on(Tear)
    def tear(self, message: Tear) -> None:
        raise ValueError("torn")


@pytest.mark.parametrize("order", ["before the next one", "behind the next one"])
async def test_a_snapshot_whose_life_ends_before_it_is_kept_leaves_no_pack(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, order: str
) -> None:
    """What is kept late goes with the next snapshot that is kept behind it."""
    begun, may_keep, is_kept = threading.Event(), threading.Event(), threading.Event()
    keep, numbers = SqliteJournal.keep_blocks, list[int]()

    def keep_late(self: SqliteJournal, address: str, number: int, *args: Any) -> None:
        numbers.append(number)
        is_first = number == numbers[0]
        begun.set()
        if is_first or order == "before the next one":
            assert (may_keep if is_first else is_kept).wait(20.0)
        keep(self, address, number, *args)
        is_kept.set()

    spec = hf.child("sheet", hf.start(Brittle), recovery=hf.hybrid(interval=NEVER, keep=1))
    async with running(tmp_path / "app.db") as system:
        ref = await system.start(spec)
        await ref.ask(Paint(0, 0))
        monkeypatch.setattr(SqliteJournal, "keep_blocks", keep_late)
        saving = asyncio.ensure_future(system.checkpoint(ref, timeout=20.0))
        assert await asyncio.to_thread(begun.wait, 20.0)
        (late,) = saves()
        with pytest.raises(hf.HoldfastError, match="torn"):
            await ref.ask(Tear())
        assert await ref.ask(Paint(0, 0)) == 2  # The next life is there.
        if order == "behind the next one":
            await saving  # It is the next life's.
            await asyncio.gather(*(saves() - {late}))
        may_keep.set()
        await saving
        await asyncio.gather(*saves())
        if order == "behind the next one":
            await ref.ask(Paint(0, 0))
            await system.checkpoint(ref, timeout=20.0)
            await asyncio.gather(*saves())
        assert len(numbers) == (2 if order == "before the next one" else 3)
        assert numbers[0] not in system._homes.journal.packs("/app/sheet")
