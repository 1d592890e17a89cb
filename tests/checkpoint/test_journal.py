"""Every journal engine keeps the same promises."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from holdfast.actors.errors import HoldfastError
from holdfast.checkpoint.journal import (
    DamagedStore,
    Journal,
    MemoryJournal,
    StaleEpoch,
    StoreFailed,
    StoreInUse,
)
from holdfast.checkpoint.sqlite import SqliteJournal
from tests.checkpoint.sqlite.stores import A, B, inputs, numbers


@pytest.fixture(params=["memory", "os", "fsync"])
def journal(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Journal]:
    path = tmp_path / "app.db"
    engine: Journal = MemoryJournal() if request.param == "memory" else SqliteJournal(path, synchronous=request.param)
    with closing(engine):
        yield engine


def test_positions_rise(journal: Journal) -> None:
    positions = [*journal.append(inputs(1)), *journal.append(inputs(3)), *journal.append([])]
    journal.cut(A, b"s", positions, turn=4)
    positions += journal.append([*inputs(2, B), *inputs(1)])
    assert len(positions) == 7
    assert positions == sorted(set(positions))
    assert all(type(position) is int for position in positions)


def test_unknown_addresses_are_empty(journal: Journal) -> None:
    assert journal.load("/nobody") == (None, 0, [], "")
    journal.erase("/nobody")


def test_notes_are_kept_and_forgotten(journal: Journal) -> None:
    assert journal.noted("children") is None
    for value in (b"one", b"", b"two"):
        journal.note("children", value)
        assert journal.noted("children") == value
    journal.note("children", None)
    journal.note("children", None)
    assert journal.noted("children") is None


def test_load_gives_what_was_appended_if_anything_is_durable(journal: Journal) -> None:
    journal.append([*inputs(2), *inputs(2, B), *inputs(1, start=2)])
    assert numbers(journal.load(A)) == ([0, 1, 2] if journal.durable else [])
    assert journal.addresses() == ([A, B] if journal.durable else [])
    journal.erase(A)
    assert journal.load(A) == (None, 0, [], "")
    assert journal.addresses() == ([B] if journal.durable else [])


def test_close_twice(journal: Journal) -> None:
    journal.close()
    journal.close()


@pytest.mark.parametrize(
    "error",
    [
        StoreInUse("/app.db", 7),
        StaleEpoch("/app.db", epoch=1, current=2),
        DamagedStore("/app.db", A, 3, "bit"),
        DamagedStore("/app.db", None, None, "bit"),
        StoreFailed("/app.db", "no space"),
    ],
)
def test_errors_can_be_rebuilt_and_say_where(error: HoldfastError) -> None:
    again = type(error)(*error.args)
    assert str(again) == str(error)
    assert vars(again) == vars(error)
    assert all(str(argument) in str(error) for argument in error.args if argument is not None and argument is not False)
