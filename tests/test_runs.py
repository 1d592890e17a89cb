"""What `tests/conftest.py` makes of the tests: which rows and loops run, and what the loops see."""

from __future__ import annotations

import asyncio
import itertools

import pytest

from tests.pairs import covering, spread


@pytest.mark.parametrize("sizes", [(1,), (5,), (3, 2), (3, 3, 2), (2, 2, 2), (3, 3, 2, 2), (4, 3, 2, 2, 2)])
def test_every_pair_of_values_has_a_row(sizes: tuple[int, ...]) -> None:
    rows = list(itertools.product(*map(range, sizes)))
    kept = [rows[number] for number in covering(rows)]
    for one, other in itertools.combinations_with_replacement(range(len(sizes)), 2):
        assert {(row[one], row[other]) for row in kept} == {(row[one], row[other]) for row in rows}
    if len(sizes) > 2:
        assert len(kept) < len(rows)


def test_pairs_that_do_not_occur_are_not_missed() -> None:
    rows = [(0, 0, 0), (0, 1, 1), (1, 0, 1)]
    assert covering(rows) == [0, 1, 2]
    assert covering([()]) == [0]


@pytest.mark.parametrize("count", range(1, 12))
@pytest.mark.parametrize("some", range(1, 12))
def test_some_rows_are_spread_evenly(count: int, some: int) -> None:
    kept = spread(count, some)
    assert len(set(kept)) == len(kept) == min(count, some)
    assert kept[0] == 0
    assert kept[-1] < count
    gaps = [after - before for before, after in zip(kept, [*kept[1:], count], strict=True)]
    assert max(gaps) - min(gaps) <= 1


@pytest.mark.asyncio(loop_factories=["asyncio", "virtual"])
async def test_a_call_from_another_thread_is_seen() -> None:
    loop = asyncio.get_running_loop()
    with pytest.raises(RuntimeError, match="Non-thread-safe"):
        await asyncio.to_thread(loop.call_soon, print)
