"""Bytes that were made to cost: what they may become is bounded, in time and in memory, before anything is made."""

from __future__ import annotations

import struct
import sys
from fractions import Fraction
from typing import Any

import msgpack
import msgspec
import pytest
from msgpack import ExtType

import holdfast as hf
from holdfast.actors.kernel.codec import decode_array
from holdfast.actors.values import DamagedValue, decode_value, encode_value
from holdfast.actors.values.budget import TooMany, check_containers
from holdfast.actors.values.forms import DATACLASS, HEAD

PRIME = sys.hash_info.modulus
SET, DICT, FRACTION = ExtType(2, b""), ExtType(4, b""), ExtType(12, b"")


def value(tree: Any) -> bytes:
    packed = msgpack.packb(tree)
    assert packed is not None
    return HEAD.pack(1, 1, len(packed)) + packed


def large(number: int) -> ExtType:
    return ExtType(0, number.to_bytes(number.bit_length() // 8 + 1, "big", signed=True))


CLASHING = [large(PRIME * (at + 1)) for at in range(2_000)]
EQUAL_TUPLES = [[ExtType(1, b""), *(PRIME * (at >> shift & 7) for shift in (0, 3, 6, 9))] for at in range(4096)]


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(value([SET, *CLASHING]), id="set"),
        pytest.param(value([DICT, *(part for key in CLASHING for part in (key, 1))]), id="dict"),
        pytest.param(b"\x01\x00" + (msgpack.packb([*CLASHING]) or b""), id="list"),
        pytest.param(value([SET, *EQUAL_TUPLES]), id="tuples"),
    ],
)
def test_keys_that_were_chosen_to_clash_are_refused(data: bytes) -> None:
    with pytest.raises(DamagedValue, match="chosen to clash"):
        decode_value(data)


def test_many_large_numbers_are_fine() -> None:
    numbers = {(1 << 80) + 7 * at for at in range(100_000)}
    assert decode_value(encode_value(numbers)) == numbers
    same = [1 << 90] * 10_000
    assert decode_value(encode_value(same)) == same


def test_a_fraction_costs_no_more_than_its_bytes() -> None:
    """In lowest terms it was saved; to find that out again takes minutes for numbers of a megabyte."""
    top, bottom = (1 << 8_000_000) + 1, 1 << 8_000_000
    made = decode_value(value([FRACTION, large(top), large(bottom)]))
    assert isinstance(made, Fraction)
    assert (made.numerator, made.denominator) == (top, bottom)
    assert decode_value(encode_value(Fraction(-3, 7))) == Fraction(-3, 7)
    with pytest.raises(DamagedValue):
        decode_value(value([FRACTION, large(top), large(-bottom)]))


def test_what_another_process_names_is_not_imported() -> None:
    name = "tests.actors.values.never_imported"
    data = value([DATACLASS, f"{name}:X"])
    with pytest.raises(DamagedValue, match="is not loaded here"):
        decode_value(data, imports=False)
    assert name not in sys.modules


def test_more_lists_than_may_be_are_not_made() -> None:
    count = 4_000_000
    body = b"\xdd" + struct.pack(">I", count) + b"\x90" * count
    with pytest.raises(DamagedValue, match="lists and dicts"):
        decode_value(b"\x01\x00" + body, imports=False)
    with pytest.raises(TooMany):
        check_containers(b"\x92\x01" + body)


@pytest.mark.parametrize("made", [[1.5] * 2_000_000, b"\x90" * 3_000_000, "x" * 3_000_000, [b"\x90" * 2_000_000, {}]])
def test_what_is_only_large_is_fine(made: Any) -> None:
    data = msgspec.msgpack.encode(made)
    check_containers(data)
    assert decode_value(encode_value(made), imports=False) == made


@pytest.mark.parametrize(
    "kind", ["M8[s/0]", "m8[0s]", "|O", "O8", "nonsense", [["a", "M8[s/0]"]], [["a", "|O"]], 5, []]
)
def test_a_dtype_that_numpy_does_not_survive_is_refused(kind: Any) -> None:
    pytest.importorskip("numpy")
    head = msgspec.msgpack.encode((kind, (1,)))
    with pytest.raises((msgspec.ValidationError, ValueError, TypeError)):
        decode_array(memoryview(len(head).to_bytes(4, "little") + head + bytes(8)))


async def test_arrays_of_all_kinds_still_cross(system: hf.ActorSystem) -> None:
    np = pytest.importorskip("numpy")
    codec = system._node.codec
    fields = np.zeros(3, dtype=[("a", "<i4"), ("b", "<f8", (2,)), ("c", [("d", "|S3")])])
    for array in (np.arange(6).reshape(2, 3), np.array(["a", "bc"]), np.array(["2026-01-01"], "M8[D]"), fields):
        back = codec.decode(np.ndarray, codec.encode(array, "x"))
        assert back.dtype == array.dtype
        assert (back == array).all()
