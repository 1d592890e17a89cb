"""The best of many combinations are the best, though the others are never made."""

import itertools

from hypothesis import given
from hypothesis import strategies as st

from holdfast.diagnosis.engine.rank import Key, Ranked, Ranking, merged, products, total
from holdfast.diagnosis.model import Component, Kind

KEYS = st.builds(Key, st.integers(1, 2), st.integers(0, 1), st.sampled_from((0.5, 1.25, 4.75)), st.integers(0, 1))


@st.composite
def lists(draw: st.DrawFn) -> list[list[Ranked]]:
    numbers = itertools.count()
    made = draw(st.lists(st.lists(KEYS, min_size=1, max_size=4), max_size=4))
    return [sorted((key, (next(numbers),)) for key in keys) for keys in made]


@given(lists())
def test_unions_come_once_each_and_best_first(some: list[list[Ranked]]) -> None:
    made = list(products(some))
    assert [key for key, _ in made] == sorted(key for key, _ in made)
    expected = {frozenset(m for _, one in chosen for m in one) for chosen in itertools.product(*some)}
    assert {frozenset(members) for _, members in made} == expected
    assert len(made) == len(expected)


@given(st.lists(lists(), max_size=4), st.integers(1, 20))
def test_the_best_of_several_rows_are_those_of_all_together(rows: list[list[list[Ranked]]], limit: int) -> None:
    everything = sorted(key for some in rows for key, _ in products(some))
    assert [key for key, _ in merged((products(some) for some in rows), limit)] == everything[:limit]


def test_an_empty_list_leaves_no_union() -> None:
    assert list(products([[(Key(1), (0,))], []])) == []


def test_the_order_is_size_then_repaired_then_likelihood_then_hardware() -> None:
    """T54."""
    components = (
        Component(name="device", kind=Kind.SWITCHABLE),
        Component(name="node"),
        Component(name="likely", prior=0.1),
        Component(name="repaired", prior=0.4),
    )
    ranking = Ranking(components, {"repaired"})
    assert [components[first].name for _, (first,) in ranking.singles(range(4))] == [
        "likely", "node", "device", "repaired",
    ]  # fmt: skip
    assert ranking.set([1, 2])[0] > ranking.set([3])[0]
    assert total([ranking.set([1])[0], ranking.set([2])[0]]) == ranking.set([1, 2])[0]
