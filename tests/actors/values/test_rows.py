"""Lists of arrays or tuples that are alike are written as a whole, and come back as they were."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holdfast.actors.values import UnsavableValue, decode_value, encode_value, state_digest
from tests.actors.values.samples import ARRAYS, Size, again, is_same


class Tagged(np.ndarray[Any, Any]):
    """A subclass of array."""


def poses(count: int) -> list[Any]:
    return [np.array([number, 0.5, -number]) for number in range(count)]


def np_copy(value: Any) -> Any:
    """Its equal, in other memory."""
    return np.copy(value, order="K") if isinstance(value, np.ndarray) else value


def identities(values: list[Any]) -> list[int]:
    """Which of these are one object: each as the position of the first."""
    known = [*map(id, values)]
    return [known.index(key) for key in known]


def test_arrays_that_are_alike_take_hardly_more_than_their_bytes() -> None:
    trail = poses(1000)
    assert len(encode_value(trail)) < 1.01 * sum(pose.nbytes for pose in trail)
    result = again(trail)
    assert is_same(result, trail)
    for pose in result:
        assert pose.flags.owndata
        assert pose.flags.writeable
    result[3][:] = 7
    assert is_same(result[4], trail[4])


def test_arrays_of_one_dtype_and_many_shapes_take_hardly_more_than_their_bytes() -> None:
    scans = [np.arange(number % 40).reshape(-1, *[1] * (number % 3)) for number in range(100)] + [np.array(5)]
    assert len(encode_value(scans)) < sum(scan.nbytes for scan in scans) + 100 * 12
    result = again(scans)
    assert is_same(result, scans)
    assert all(scan.flags.owndata and scan.flags.writeable for scan in result)


def test_an_array_that_is_in_the_list_and_elsewhere_is_one_object_again() -> None:
    trail = poses(100)
    for state in ({"pose": trail[99], "trail": trail}, {"trail": trail, "pose": trail[99]}):
        result = again(state)
        assert result["trail"][99] is result["pose"]
        assert is_same(result["trail"], trail)
        assert len(encode_value(state)) < 1.1 * 100 * 24
    both = again([trail, trail[::-1]])
    assert identities(both[0] + both[1]) == [*range(100), *reversed(range(100))]


def test_an_array_that_is_in_the_list_twice_is_one_object_again() -> None:
    trail = poses(100)
    trail[70] = trail[7]
    result = again(trail)
    assert identities(result) == identities(trail)
    assert is_same(result, trail)


def test_tuples_of_scalars_return_whatever_is_in_them() -> None:
    rows: list[Any] = [(number, 0.5) for number in range(100)]
    assert len(encode_value(rows)) < 100 * 11 + 20
    rows += [(), (None, True, "text", "\ud800", b"b"), (2**70, -(2**70)), (float("nan"), -0.0)]
    assert is_same(again(rows), rows)
    for other in ([1], Size(1), (1, [2]), (1, (2,))):
        assert is_same(again([*rows, other]), [*rows, other])
        assert is_same(again([other, *rows]), [other, *rows])


def test_refusal_names_the_entry() -> None:
    with pytest.raises(UnsavableValue, match=r"trail\[8\]\[1\]: a value of type object"):
        encode_value([*[(1, 2)] * 8, (1, object())], where="trail")
    with pytest.raises(UnsavableValue, match=r"trail\[8\]: a numpy value of dtype object"):
        encode_value([*poses(8), np.array([None, None, None])], where="trail")
    with pytest.raises(UnsavableValue, match=r"trail\[8\]: a value of type .*Tagged"):
        encode_value([*poses(8), np.zeros(3).view(Tagged)], where="trail")


def test_what_was_saved_so_can_be_read_for_ever() -> None:
    shared = np.array([3, 4], "<i2")
    value = [
        shared,
        [np.array([number, 1], "<i2") for number in range(8)] + [shared],
        [np.zeros((number % 2, 1), "<i2") for number in range(8)],
        [(1, "a")] * 8,
    ]
    data = bytes.fromhex(
        "0101000000000000007f9493c700200095c70030a33c693292c7000102a14392c700220496c70036a33c693292c700010292c700"
        "22240892c700210094c70036a33c693299c7002892000192010192000192010192000192010192000192010192c700220899c700"
        "289201a1619201a1619201a1619201a1619201a1619201a1619201a1619201a16103000400000001000100010002000100030001"
        "0004000100050001000600010007000100030004000000000000000000"
    )
    assert is_same(decode_value(data), value)


READ_ONLY = np.arange(3.0)
READ_ONLY.flags.writeable = False
NUMBERS = np.arange(40.0).reshape(4, 10)
ENTRIES: list[Any] = [
    *ARRAYS, READ_ONLY, NUMBERS[0, :3], NUMBERS[1, ::4], NUMBERS[:3, 0], NUMBERS[0, :3].astype(">f8"), np.zeros((0,)),
    np.zeros((3, 1)), np.zeros((1, 3)), np.zeros((3, 2), order="F"), np.zeros((3, 2)), np.zeros(200),
    np.zeros((20, 20), order="F"), np.zeros(400)[::2], np.zeros(100, "G"), np.arange(3),
    np.arange(3, dtype="q"), (1, 2.5), (3, "x"), (), [1], None, 5,
]  # fmt: skip
like = st.sampled_from(
    [
        np_copy,
        lambda entry: entry,  # the very same
        lambda entry: entry[...] if isinstance(entry, np.ndarray) else entry,  # a view of it
    ]
)


@st.composite
def lists(draw: st.DrawFn) -> list[Any]:
    """Mostly equals of one entry, and a few others among them."""
    entry = draw(st.sampled_from(ENTRIES))
    made = [draw(like)(entry) for _ in range(draw(st.integers(0, 3)))]
    made += [np_copy(entry) for _ in range(draw(st.integers(6, 20)))]
    made += [draw(like)(one) for one in draw(st.lists(st.sampled_from(ENTRIES), max_size=2))]
    return draw(st.permutations(made)) if draw(st.booleans()) else made


@settings(max_examples=50)
@given(st.lists(lists(), min_size=1, max_size=3), st.data())
def test_any_lists_return_with_what_they_share(values: list[list[Any]], data: st.DataObject) -> None:
    for _ in range(data.draw(st.integers(0, 3))):
        values.append([data.draw(st.sampled_from(data.draw(st.sampled_from(values))))])
    result: Any = again(values)
    assert is_same(result, values)
    before, after = ([one for part in whole for one in part] for whole in (values, result))
    arrays = [at for at, one in enumerate(before) if isinstance(one, np.ndarray)]
    assert identities([after[at] for at in arrays]) == identities([before[at] for at in arrays])
    assert all(after[at].flags.writeable and after[at].flags.owndata for at in arrays)
    assert state_digest(result) == state_digest(values) == state_digest([[*map(np_copy, part)] for part in values])
