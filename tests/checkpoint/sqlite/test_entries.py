"""Entries come back from the store exactly as given, or are refused."""

from __future__ import annotations

import math
import shutil
import signal
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from holdfast.checkpoint.journal import (
    Entry,
)
from holdfast.checkpoint.sqlite import SqliteJournal
from tests.checkpoint.sqlite.stores import A, B, inputs, numbers


def same(one: object, two: object) -> bool:
    """Equal in type and value, all the way down; NaN is itself, and -0.0 is not 0.0."""
    if type(one) is not type(two):
        return False
    if isinstance(one, tuple) and isinstance(two, tuple):
        return len(one) == len(two) and all(map(same, one, two))
    if isinstance(one, float) and isinstance(two, float):
        return (math.isnan(one) and math.isnan(two)) or (one == two and math.copysign(1, one) == math.copysign(1, two))
    return one == two


scalars = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.integers(-(2**200), 2**200),
    st.floats(),
    st.text(st.characters()),  # lone surrogates too
    st.binary(),
)
values = st.recursive(scalars, lambda inner: st.lists(inner, max_size=4).map(tuple), max_leaves=12)
written = st.tuples(
    st.sampled_from([A, B, "", "/ä\n'\""]),
    st.tuples(st.sampled_from(["in", "out", "got", "end", "note"]), st.lists(values, max_size=5)).map(
        lambda pair: (pair[0], *pair[1])
    ),
)


@given(batches=st.lists(st.lists(written, max_size=5), max_size=5))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=40)
def test_entries_come_back_exactly(path: Path, batches: list[list[tuple[str, Entry]]]) -> None:
    shutil.rmtree(path.parent)
    path.parent.mkdir()
    expected: dict[str, list[tuple[int, Entry]]] = {}
    with closing(SqliteJournal(path)) as journal:
        for batch in batches:
            for (address, entry), position in zip(batch, journal.append(batch), strict=True):
                expected.setdefault(address, []).append((position, entry))
    with closing(SqliteJournal(path)) as journal:
        assert journal.addresses() == sorted(expected)
        assert all(same(tuple(journal.load(address).entries), tuple(rows)) for address, rows in expected.items())


@pytest.mark.parametrize("bad", [[1], {1: 2}, {1}, bytearray(b"x"), signal.SIGTERM, object(), 1j])
def test_what_would_not_come_back_is_refused_and_nothing_is_written(store: SqliteJournal, bad: Any) -> None:
    for entry in (("in", bad), ("in", (1, (bad,))), (1, "in"), (), ["in"]):
        with pytest.raises(TypeError):
            store.append([*inputs(1), (A, entry)])  # type: ignore[list-item]
    assert store.append(inputs(1)) == [1]
    assert numbers(store.load(A)) == [0]
