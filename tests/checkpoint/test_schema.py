"""States of other versions: of the class, of holdfast itself (T28)."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

import holdfast as hf
from holdfast.checkpoint.journal import Saved
from tests.checkpoint.fixture_player import CHECKED, FOLDER, Die, Record, Show, expected
from tests.checkpoint.strikes import NEVER


class Get(hf.Message[list[float]]): ...


@hf.renamed(f"{__name__}:New", f"{__name__}:Stubborn", f"{__name__}:Never")
class Old(hf.Actor):
    def __init__(self) -> None:
        self.total = 7
        self.grid = np.ones(200_000)

    @hf.on(Get, readonly=True)
    def get(self, message: Get) -> list[float]:
        return [self.total, float(self.grid.sum())]


@hf.renamed(f"{__name__}:Old", f"{__name__}:Never")
class New(hf.Actor):
    """Keeps the sum in another variable, as two numbers."""

    schema_version: ClassVar[int] = 3

    def __init__(self) -> None:
        self.parts: list[int] = [0, 0]
        self.grid = np.zeros(200_000)

    @classmethod
    def migrate(cls, state: dict[str, Any], from_version: int) -> dict[str, Any]:
        if from_version != 1:
            raise ValueError(f"version {from_version} was never in use")
        return {"parts": [state["total"], from_version], "grid": state["grid"]}

    @hf.on(Get, readonly=True)
    def get(self, message: Get) -> list[float]:
        return [*self.parts, float(self.grid.sum())]


@hf.renamed(f"{__name__}:Old", f"{__name__}:New", f"{__name__}:Stubborn")
class Never(New):
    """Comes from a version that `migrate` does not know."""

    schema_version: ClassVar[int] = 2


@hf.renamed(f"{__name__}:Old", f"{__name__}:New", f"{__name__}:Stubborn")
class Stubborn(Old):
    """Has another version, and no way to it."""

    schema_version: ClassVar[int] = 2


async def begun(system: hf.ActorSystem, kind: type[hf.Actor], isolation: Any = "task") -> hf.ActorRef[Any]:
    spec = hf.child("x", hf.start(kind), isolation=isolation, restart="temporary", recovery=hf.hybrid(interval=NEVER))
    return await system.start(spec)


async def recorded(store: str, kind: type[hf.Actor]) -> None:
    async with hf.ActorSystem("app", store=store, log=False) as system:
        ref = await begun(system, kind)
        await ref.ask(Get())
        await system.checkpoint(ref, timeout=20.0)


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_an_older_state_is_migrated(tmp_path: Path, isolation: str) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    await recorded(store, Old)
    for _ in range(2):  # The second time it is of the present version.
        async with hf.ActorSystem("app", store=store, log=False) as system:
            ref = await begun(system, New, isolation)
            assert await ref.ask(Get(), timeout=20.0) == [7, 1, 200_000.0]


@pytest.mark.parametrize(
    ("saver", "loader", "problem"),
    [
        (Old, Stubborn, "has no classmethod migrate"),
        (Stubborn, Old, "has schema version 2"),
        (New, Never, "an older class cannot read the state of a newer one"),
        (Never, New, "version 2 was never in use"),
    ],
)
async def test_what_cannot_be_migrated_is_refused_and_kept(
    tmp_path: Path, saver: type[hf.Actor], loader: type[hf.Actor], problem: str
) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    await recorded(store, saver)
    before = await look(store)
    async with hf.ActorSystem("app", store=store, log=False) as system:
        with pytest.raises(hf.StartFailed, match=problem):
            await begun(system, loader)
    assert await look(store) == before, "nothing of it was touched"
    async with hf.ActorSystem("app", store=store, log=False) as system:
        ref = await begun(system, saver)
        assert (await ref.ask(Get()))[-1] in (200_000.0, 0.0)


async def look(store: str) -> tuple[bytes | None, int]:
    async with hf.ActorSystem("app", store=store, log=False) as system:
        saved: Saved = system._homes.journal.load("/app/x")
        return saved.snapshot, saved.turn


@pytest.mark.parametrize(("name", "cells"), [("one-value.db", 10), ("image.db", 200_000)])
@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_what_an_earlier_holdfast_has_recorded_is_read(
    tmp_path: Path, name: str, cells: int, isolation: Any
) -> None:
    copied(name, tmp_path)
    recovery = hf.hybrid(interval=NEVER)
    async with hf.ActorSystem("app", store=f"sqlite:{tmp_path / name}", log=False) as system:
        assert system._homes.journal.load("/app/record").entries, "there is something to replay"
        spec = hf.child("record", hf.start(Record, cells), isolation=isolation, recovery=recovery)
        ref = await system.start(spec)
        assert await ref.ask(Show(), timeout=20.0) == expected(cells)


def copied(name: str, folder: Path) -> None:
    """A fixture to work with."""
    for part in ("", "-snapshots", "-packs"):
        source = FOLDER / f"{name}{part}"
        if source.is_dir():
            shutil.copytree(source, folder / source.name)
        elif source.exists():
            shutil.copy(source, folder / source.name)


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_digests_quarantine_and_group_of_an_earlier_holdfast_are_read(tmp_path: Path, isolation: Any) -> None:
    copied("checked.db", tmp_path)
    store = f"sqlite:{tmp_path / 'checked.db'}"
    async with hf.ActorSystem("app", store=store, log=False) as system:
        entries = system._homes.journal.load("/app/record").entries
        assert any(entry[0] == "end" and len(entry) == 6 for _, entry in entries), "there are digests to compare"
        ref = await system.start(hf.child("record", hf.start(Record, 10), isolation=isolation, recovery=CHECKED))
        assert await ref.ask(Show(), timeout=20.0) == expected(10)
        assert [(one.message, one.attempts) for one in system.quarantined()] == [(Die(), 1)]
        assert system.group_snapshots() == ["three"]
        await system.restore_group("three")
        assert (await ref.ask(Show(), timeout=20.0))[0] == "[1, 2, 3]"


async def test_a_snapshot_of_a_later_holdfast_is_refused(tmp_path: Path) -> None:
    import msgspec

    from holdfast.checkpoint.snapshot.snapshot_record import decode_meta, encode_meta

    store = f"sqlite:{tmp_path / 'app.db'}"
    await recorded(store, Stubborn)
    async with hf.ActorSystem("app", store=store, log=False) as system:
        journal = system._homes.journal
        saved = journal.load("/app/x")
        assert saved.snapshot is not None
        later = msgspec.structs.replace(decode_meta(saved.snapshot), format=9)
        journal.cut("/app/x", encode_meta(later, False), [], turn=saved.turn, keep=1)
    async with hf.ActorSystem("app", store=store, log=False) as system:
        with pytest.raises(hf.HoldfastError, match="format 9"):
            await begun(system, Stubborn)
