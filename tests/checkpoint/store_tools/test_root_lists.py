"""The root's own lists in a store, once they are long enough to have been written anew: every tool takes them."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import msgspec
import pytest

from holdfast.actors.errors import HoldfastError
from holdfast.checkpoint.home.ask_recovery import FAR, FarAnswer, FarKept
from holdfast.checkpoint.home.quarantine import PLACE, QuarantineEntry
from holdfast.checkpoint.sqlite import SqliteJournal
from holdfast.checkpoint.store_tools import (
    back_up_store,
    compact_store,
    export_store,
    rekey_store,
    store_stats,
    verify_store,
)
from holdfast.cluster.joining import open_store
from holdfast.cluster.store_copy import copy_store
from tests.checkpoint.sqlite.stores import A
from tests.checkpoint.store_tools.writing import filled

KEY = bytes(range(32))
LISTS: dict[str, Any] = {
    FAR: FarKept([FarAnswer("/shop/x", 1, 2, "reply", "m:Buy", b"\x91\x05")], [], [7]),
    PLACE: [QuarantineEntry(A, 3, "tell", "m:Boom", b"\x90", None, "", 2, 1.0)],
}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A store with both lists, as `_tidy` writes them, and entries behind."""
    path = filled(tmp_path / "a" / "app.db")
    with closing(SqliteJournal(path)) as journal:
        for address, kept in LISTS.items():
            positions = journal.append([(address, ("free", A, number)) for number in range(4)])
            journal.cut(address, msgspec.msgpack.encode(kept), positions[:3], turn=1, keep=1)
    return path


def kept_in(path: Path, key: bytes | None = None) -> dict[str, Any]:
    """What the next root reads of the lists."""
    with closing(SqliteJournal(path, key=key)) as journal:
        saved = {address: journal.load(address) for address in LISTS}
    assert [len(one.entries) for one in saved.values()] == [1, 1]
    return {
        address: msgspec.msgpack.decode(one.snapshot or b"", type=kind)
        for (address, one), kind in zip(saved.items(), (FarKept, list[QuarantineEntry]), strict=True)
    }


def test_they_are_no_damage_and_are_counted_and_exported(path: Path) -> None:
    found = verify_store(path)
    assert found.is_good, found.damages
    told = {one.address: one for one in store_stats(path).addresses}
    assert [(told[address].damage, told[address].entries) for address in LISTS] == [("", 1), ("", 1)]
    records = list(export_store(path))
    assert [record for record in records if record["record"] == "damage"] == []
    states = {
        one["address"]: one["state"] for one in records if one["record"] == "snapshot" and one["address"] in LISTS
    }
    assert states[FAR][0][0][:3] == ["/shop/x", 1, 2]
    assert states[PLACE][0][:2] == [A, 3]


def test_copies_have_them(path: Path, tmp_path: Path) -> None:
    back_up_store(path, tmp_path / "b.db")
    rekey_store(path, tmp_path / "c.db", new_key=KEY)
    compact_store(path)
    with closing(open_store(f"sqlite:{path}")) as one, closing(open_store(f"sqlite:{tmp_path / 'd.db'}")) as other:
        copy_store(one, other, names=("a", "d"))
    for name, key in (("a/app.db", None), ("b.db", None), ("c.db", KEY), ("d.db", None)):
        assert kept_in(tmp_path / name, key) == LISTS


def test_a_snapshot_that_cannot_be_copied_is_told_with_its_address(path: Path, tmp_path: Path) -> None:
    with closing(open_store(f"sqlite:{path}")) as one, closing(open_store(f"sqlite:{tmp_path / 'd.db'}")) as other:
        one.cut(A, msgspec.msgpack.encode([1, 2, 3]), [], turn=9)
        with pytest.raises(HoldfastError, match=f"{A} cannot be copied: .* or restore the store from a backup"):
            copy_store(one, other, names=("a", "d"))
