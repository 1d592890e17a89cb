"""The engines there are, and one of a user's own, keep to the store protocol."""

from __future__ import annotations

import os
import shutil
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.checkpoint.journal import Journal, MemoryJournal
from holdfast.checkpoint.sqlite import SqliteJournal
from holdfast.checkpoint.store_opening import open_journal
from holdfast.testing.schedules.disk import SimulatedDisk, SimulatedJournal
from holdfast.testing.stores import conformance
from tests.checkpoint.one_file import OneFile
from tests.checkpoint.players import Doer, Note, Seen
from tests.checkpoint.sqlite.stores import KEY, disown


def killed(journal: Journal, folder: Path, key: bytes | None = None) -> Path:
    """The files as they are now, with an owner that is dead."""
    copy = folder.with_name(str(int(folder.name) + 1))
    shutil.copytree(folder, copy)
    disown(copy / "app.db", key)
    return copy


class TestSqlite(conformance(lambda path: SqliteJournal(path / "app.db"), crash=killed)):  # type: ignore[misc]
    """The store of `store="sqlite:PATH"`."""


def synced(path: Path) -> Journal:
    return SqliteJournal(path / "app.db", synchronous="fsync")


@pytest.mark.skipif(
    "HOLDFAST_CROSSED" not in os.environ,
    reason="a campaign: HOLDFAST_CROSSED=1; the code is that of TestSqlite, and what a sync is worth shows test_power",
)
class TestSqliteSynced(conformance(synced, crash=killed)):  # type: ignore[misc]
    """The same, when each append is synced."""


def encrypted(path: Path) -> Journal:
    return SqliteJournal(path / "app.db", key=KEY)


class TestSqliteEncrypted(conformance(encrypted, crash=partial(killed, key=KEY))):  # type: ignore[misc]
    """The same, with a key."""


class TestMemory(conformance(lambda path: MemoryJournal())):  # type: ignore[misc]
    """No store."""


def copied(journal: Journal, folder: Path) -> Path:
    copy = folder.with_name(str(int(folder.name) + 1))
    shutil.copytree(folder, copy)
    return copy


class TestOneFile(conformance(lambda path: OneFile(path / "my.store"), crash=copied)):  # type: ignore[misc]
    """One of a user's own."""


DISKS: list[SimulatedDisk] = []
"""A folder has a file that says which one is in it."""


def placed(folder: Path, disk: SimulatedDisk) -> None:
    (folder / "disk").write_text(str(len(DISKS)), encoding="ascii")
    DISKS.append(disk)


def disk_in(folder: Path) -> SimulatedDisk:
    return DISKS[int((folder / "disk").read_text(encoding="ascii"))]


def simulated(folder: Path) -> Journal:
    if not (folder / "disk").exists():
        placed(folder, SimulatedDisk())
    return disk_in(folder).open()


def left(journal: SimulatedJournal, folder: Path) -> Path:
    copy = folder.with_name(str(int(folder.name) + 1))
    copy.mkdir()
    placed(copy, deepcopy(disk_in(folder)))
    return copy


class TestSimulated(conformance(simulated, crash=left)):  # type: ignore[misc]
    """The store of a simulated run."""


@pytest.mark.parametrize("kind", [SqliteJournal, OneFile])
async def test_a_system_takes_an_engine_that_is_open(tmp_path: Path, kind: type[Any]) -> None:
    for life in range(2):
        engine: Journal = kind(tmp_path / "app.db")
        async with hf.ActorSystem("app", log=False, store=engine) as system:
            doer = await system.start(hf.child("doer", hf.start(Doer), recovery=hf.hybrid()))
            await doer.ask(Note(str(life)))
            assert await doer.ask(Seen()) == ["0", "1"][: life + 1]


async def test_a_store_of_another_system_is_refused_and_kept(tmp_path: Path) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    for name, count in (("app", 1), ("application", 0), ("app", 2)):
        system = hf.ActorSystem(name, log=False, store=store)
        if not count:
            with pytest.raises(hf.SpecError, match="recorded in the system 'app', and nothing of 'application'"):
                await system.__aenter__()
            continue
        async with system:
            doer = await system.start(hf.child("doer", hf.start(Doer), recovery=hf.hybrid()))
            assert await doer.ask(Note("one")) == count


@pytest.mark.parametrize("place", ["not/there/app.db", ""])
def test_a_store_without_a_place_is_refused(tmp_path: Path, place: str) -> None:
    """Also a mistyped one: its folder is not made."""
    with pytest.raises(hf.SpecError, match="must name a file in a folder that is there"):
        open_journal(f"sqlite:{tmp_path / place}")
    assert not list(tmp_path.iterdir())
