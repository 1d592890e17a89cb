"""Damaged snapshots: an older one and the messages since, or a loud refusal; never a wrong state (T10, T11, T28)."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
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
            (said,) = [one for one in stream.take() if isinstance(one, hf.SnapshotDamaged)]
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
            assert [one for one in stream.take() if isinstance(one, hf.SnapshotDamaged)]


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
