"""Values come back with their types and their sharing, at the price of one copy, and have a digest."""

import os
import random
import subprocess
import sys
import tracemalloc
from collections import Counter, OrderedDict, defaultdict, deque
from datetime import UTC
from decimal import Decimal, localcontext
from pathlib import Path
from typing import Any
from uuid import UUID, uuid1

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holdfast.actors.values import UnsavableValue, decode_value, encode_value, state_digest
from tests.actors.values.samples import (
    BASE,
    VALUES,
    Access,
    Box,
    Colour,
    Counted,
    Derived,
    Frozen,
    FrozenSlotted,
    Level,
    Loose,
    Node,
    NotedSize,
    Point,
    Reading,
    Size,
    Slotted,
    again,
    cyclic_list,
    is_same,
)


@pytest.mark.parametrize("value", VALUES, ids=lambda value: type(value).__name__)
def test_value_returns_with_its_type(value: object) -> None:
    assert is_same(again(value), value)
    for inside in ([value, 0], {"k": value}, (value,), {"deep": [(deque([value]),)]}):
        assert is_same(again(inside), inside)


def test_the_comparison_of_these_tests_sees_differences() -> None:
    different = [1, 1.0, True, 0.0, -0.0, "1", b"1", bytearray(b"1"), (1,), [1], {1}, frozenset({1}), {1: 1}, {1: 1.0}]
    different += [{1: 1, 2: 2}, {2: 2, 1: 1}, deque([1]), deque([1], 3), Counter({1: 1}), OrderedDict({1: 1})]
    different += [
        defaultdict(int, {1: 1}),
        defaultdict[int, Any](list, {1: 1}),
        np.int64(1),
        np.int32(1),
        np.array(1),
        Point(1),
        Point(1, 1),
    ]
    assert [(a, b) for i, a in enumerate(different) for b in different[i + 1 :] if is_same(a, b)] == []


# What is not equal to its like, or not only that.


def test_attributes_beside_the_fields_return_and_init_is_not_called() -> None:
    value = Point(1)
    value.cache = {"found": (1,)}  # type: ignore[attr-defined]
    del value.y
    made = Point.made
    result = again(value)
    assert Point.made == made
    assert vars(result) == {"x": 1, "cache": {"found": (1,)}}


def test_slots_return_even_if_private_or_inherited_or_unset() -> None:
    value = Derived(1)
    value.hide([1])
    assert again(value).shown() == [1]
    with pytest.raises(AttributeError):
        again(Derived(1)).shown()


def test_struct_returns_as_it_was_whatever_its_post_init_does() -> None:
    value = Counted(1)
    assert value.n == 2
    assert again(value) == value


def test_struct_and_named_tuple_return_with_what_their_dict_holds() -> None:
    loose, size = Loose(some_field=1), NotedSize(1, 2)
    loose.extra = (1, 2)  # type: ignore[attr-defined]
    size.note = {3}  # type: ignore[attr-defined]
    assert again(loose).extra == (1, 2)
    assert again(size).note == {3}


def test_uuid_returns_with_its_safety_and_decimal_whatever_the_context() -> None:
    value = UUID(int=1, is_safe=uuid1().is_safe)
    with localcontext(prec=2):
        assert is_same(again(Decimal("1.23456789")), Decimal("1.23456789"))
    assert again(value).is_safe is value.is_safe


def test_dict_keys_of_all_kinds_stay_apart_and_in_order() -> None:
    value = {
        1: "int",
        "1": "str",
        b"1": "bytes",
        (1,): "tuple",
        frozenset({1}): "set",
        Level.HIGH: "enum",
        Frozen("f"): [2],
    }
    assert [(type(k), k, v) for k, v in again(value).items()] == [(type(k), k, v) for k, v in value.items()]


def test_bytearray_is_not_taken_for_bytes_wherever_it_is() -> None:
    # msgpack's packer takes it for bytes without a word.
    value = {1: [({"a": bytearray(b"x")},)], (2,): deque([bytearray(b"y")])}
    assert is_same(again(value), value)


# Sharing.


@pytest.mark.parametrize(
    "shared",
    [[1], {"a": 1}, {(1,): 2}, {1}, bytearray(b"x"), deque([1]), Counter("a"), defaultdict(list), OrderedDict(a=1),
     Point(1), Slotted(1), Loose(some_field=1), Frozen("x"), np.arange(3), random.Random(1), np.random.default_rng(1)],
    ids=lambda value: type(value).__name__,
)  # fmt: skip
def test_what_is_reached_twice_is_one_object_again(shared: object) -> None:
    first, second, (third, *_), other = again([shared, {"k": shared}, (shared, [5, 5]), [shared]])
    assert second["k"] is first
    assert third is first
    assert other[0] is first
    assert type(first) is type(shared)
    assert [*again([first]), 0][0] is not first


def test_sharing_inside_what_is_shared_and_beside_equal_things() -> None:
    inner: list[Any] = [1]
    outer = {"inner": inner, "equal": [1]}
    a, b, c = again((outer, [outer, inner], Box(inner)))
    assert b[0] is a
    assert b[1] is c.content is a["inner"]
    assert a["equal"] == [1]
    assert a["equal"] is not a["inner"]


def test_shared_dict_key_is_one_object_again() -> None:
    node = Node()  # hashed by identity
    found, mapping, members = again([node, {node: "found"}, {node}])
    assert mapping[found] == "found"
    assert members == {found}


def test_what_cannot_change_needs_no_identity() -> None:
    row = (1, 2, 3)
    assert again([row] * 1000) == [row] * 1000
    assert again([Level.LOW, np.float64(1)] * 2) == [Level.LOW, 1.0] * 2


def test_class_of_the_main_module_is_found_in_another_main_module(tmp_path: Path) -> None:
    program = (
        "import dataclasses, sys\n"
        "from holdfast.actors.values import encode_value, decode_value\n"
        "@dataclasses.dataclass\n"
        "class Here:\n    a: int\n"
        "if len(sys.argv) == 2: print(repr(decode_value(bytes.fromhex(sys.argv[1]))))\n"
        "else:\n"
        "    Here.__module__ = '__mp_main__'\n"  # as it is in a child of multiprocessing
        "    sys.modules['__mp_main__'] = sys.modules['__main__']\n"
        "    print(encode_value(Here(7)).hex())\n"
    )
    (tmp_path / "program.py").write_text(program)
    run = [sys.executable, str(tmp_path / "program.py")]
    data = subprocess.run(run, check=True, capture_output=True, text=True).stdout.strip()
    assert subprocess.run([*run, data], check=True, capture_output=True, text=True).stdout == "Here(a=7)\n"


# Memory.


@pytest.mark.parametrize("value", [np.ones(1_000_000), bytearray(8_000_000)], ids=["array", "bytearray"])
def test_large_buffers_are_copied_once_each_way(value: Any) -> None:
    encode_value(value[:1])
    tracemalloc.start()
    try:
        data = encode_value({"state": (value, [1])})
        assert tracemalloc.get_traced_memory()[1] < 1.1 * 8_000_000
        tracemalloc.reset_peak()
        result = decode_value(data)
        assert tracemalloc.get_traced_memory()[1] - len(data) < 1.1 * 8_000_000
    finally:
        tracemalloc.stop()
    assert is_same(result, {"state": (value, [1])})


def test_large_bytes_are_copied_as_often_as_by_msgpack() -> None:
    value = ({index: bytes(65_536) for index in range(100)},)
    tracemalloc.start()
    encode_value(value)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3.1 * 6_553_600  # into the packer's buffer, which grows by doubling, and out of it


# Digests.


def test_digest_depends_on_types_and_contents() -> None:
    values = [1, 1.0, True, "1", b"1", bytearray(b"1"), [1], (1,), {1}, frozenset({1}), {1: 2}, Counter({1: 2})]
    values += [deque([1]), deque([1], 1), {"a": 1, "b": 2}, {"b": 2, "a": 1}, 0.0, -0.0, None, Level.LOW]
    values += [Point(1), Point(2), np.int64(1), np.array(1), np.array([1]), np.array([1.0])]
    digests = {state_digest(value) for value in values}
    assert len(digests) == len(values)
    assert {len(digest) for digest in digests} == {16}


def test_digest_is_blind_to_sharing_and_to_the_order_of_sets() -> None:
    shared = [1, {2}]
    assert state_digest([shared, (shared, shared)]) == state_digest([[1, {2}], ([1, {2}], [1, {2}])])
    for members in ([0, 8, 16], [0, 8, 16, 2.5]):  # 0, 8 and 16 collide, so the first that comes is the first
        one, other = {*members}, {*reversed(members)}
        assert [*one] != [*other]
        assert state_digest(one) == state_digest(other)
        assert state_digest(frozenset(one)) == state_digest(frozenset(other)) != state_digest(one)
    assert state_digest([BASE]) == state_digest([np.asfortranarray(BASE)]) == state_digest([BASE[::-1][::-1]])
    with pytest.raises(UnsavableValue, match="contains itself"):
        state_digest(cyclic_list())


def test_digest_is_the_same_in_processes_that_hash_differently() -> None:
    program = (
        "from holdfast.actors.values import state_digest\n"
        "words = [f'w{i}' for i in range(50)]\n"
        "print(state_digest({'words': set(words), 'mixed': {*words, (1, 'x'), b'y', frozenset(words)}}).hex())"
    )
    digests = {
        subprocess.run(
            [sys.executable, "-c", program], env={**os.environ, "PYTHONHASHSEED": seed}, check=True, capture_output=True
        ).stdout
        for seed in ("1", "2", "3")
    }
    assert len(digests) == 1


# Any structure.

leaves = st.one_of(
    st.none(), st.booleans(), st.integers(), st.integers(-(2**200), 2**200), st.floats(), st.text(),
    st.text(st.characters()), st.binary(max_size=20),
    st.binary(max_size=20).map(bytearray), st.complex_numbers(), st.decimals(), st.fractions(), st.uuids(), st.dates(),
    st.timedeltas(),
    st.datetimes(timezones=st.none() | st.timezones() | st.just(UTC)), st.times(),
    st.sampled_from([*Level, *Colour, *Access]),
    st.builds(FrozenSlotted, st.integers()), st.builds(range, st.integers(), st.integers(), st.integers(1)),
)  # fmt: skip
keys = st.recursive(
    leaves.filter(lambda x: x.__hash__ is not None and not (isinstance(x, Decimal) and x.is_snan())),
    lambda inner: st.frozensets(inner, max_size=3) | st.tuples(inner, inner) | st.builds(Frozen, inner),
    max_leaves=4,
)
values = st.recursive(
    leaves,
    lambda inner: st.one_of(
        st.lists(inner, max_size=4), st.lists(inner, max_size=4).map(tuple), st.dictionaries(keys, inner, max_size=4),
        st.dictionaries(st.text(), inner, max_size=4),
        st.sets(keys, max_size=4), st.builds(deque, st.lists(inner, max_size=4), st.none() | st.integers(0, 5)),
        st.builds(Point, inner, inner),
        st.builds(Slotted, inner), st.builds(Reading, inner), st.builds(Size, inner, inner),
        st.dictionaries(keys, inner, max_size=4).map(OrderedDict),
        st.dictionaries(keys, inner, max_size=3).map(lambda d: defaultdict(set, d)),
        inner.map(lambda x: [x, (x, {"same": x})]),
    ),
    max_leaves=20,
)  # fmt: skip


@settings(max_examples=500)
@given(values)
def test_any_structure_returns(value: object) -> None:
    result = again(value)
    assert is_same(result, value)
    assert state_digest(result) == state_digest(value)
