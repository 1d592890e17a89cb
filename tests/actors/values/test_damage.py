"""Damaged or forged bytes give a value or say so; they never do anything else."""

import contextlib
import dataclasses
import pstats
import random
import struct
from collections import Counter, OrderedDict, defaultdict, deque
from datetime import UTC, date, datetime, time, timedelta
from decimal import Decimal
from fractions import Fraction
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, cast
from uuid import UUID, SafeUUID
from zoneinfo import ZoneInfo

import msgpack
import msgspec
import msgspec.inspect
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holdfast.actors.values import DamagedValue, decode_value, encode_value
from tests.actors.values.samples import (
    ARRAYS,
    HERE,
    SCALARS,
    VALUES,
    Point,
    is_same,
)

SAMPLE = [
    {"plain": [1, -1, 2**70, "text", b"bytes", 1.5, None, True]}, (VALUES[:60],), VALUES[60:], [*ARRAYS, *SCALARS],
    [random.Random(1), np.random.default_rng(1), np.random.RandomState(1), np.random.Generator(np.random.Philox(1))],
    [shared := [1, Point(1)], {"again": (shared, {3: shared})}],
]  # fmt: skip
DATA = [*map(encode_value, SAMPLE), *map(encode_value, [*VALUES, *ARRAYS, *SCALARS])]


def read(data: bytes) -> None:
    """A value or DamagedValue: any other error fails the test."""
    with contextlib.suppress(DamagedValue):
        decode_value(data)


def packed(tree: object) -> bytes:
    return cast(bytes, msgpack.packb(tree))


def mark(code: int, *parts: object) -> list[object]:
    return [msgpack.ExtType(code, b""), *parts]


def forged(tree: object, buffers: bytes = b"") -> bytes:
    return struct.pack(">BBQ", 1, 1, len(packed(tree))) + packed(tree) + buffers


FORGED = {
    "mark outside a list": {"a": msgpack.ExtType(1, b"")},
    "mark behind the head": [1, msgpack.ExtType(1, b"")],
    "mark with contents": [msgpack.ExtType(1, b"x"), 1],
    "unknown mark": mark(31, 1),
    "unknown object": mark(33, 0),
    "object before it is there": [mark(33, 0), mark(32, 0, [])],
    "pairs of an odd number": mark(5, 1),
    "unhashable member": mark(2, [1]),
    "unhashable key": mark(4, [1], 2),
    "buffer that is not there": mark(34, 1),
    "buffer of negative size": mark(34, -1),
    "bytearray of a trillion": mark(8, 10**12),
    "fraction of a billion digits": mark(12, mark(11, "1E+999999999")),
    "shape without an end": mark(48, "|V0", mark(10, 0, 10**12, 1), "C", mark(34, 0)),
    "shape below zero": mark(48, "|V0", mark(1, -1), "C", mark(34, 0)),  # numpy divides by zero
    "time unit of nothing": mark(48, "<M8[0s]", mark(1, 0), "C", mark(34, 0)),
    "array of objects": mark(48, "|O", mark(1, 0), "C", mark(34, 0)),
    "array of objects in fields": mark(48, [[["a", "|O", 0]], 8, False], mark(1, 0), "C", mark(34, 0)),
    "bytes of a trillion": mark(49, 10**12),
    "seed with a large pool": mark(51, 1, mark(1), 10**6, 0),
    "seed without an end": mark(51, mark(10, 0, 10**12, 1), mark(1), 4, 0),
    "generator from nothing": mark(52, 1),
    "generator of another module": mark(50, {"bit_generator": "RandomState", "state": {}}, None),
    "class of a module": mark(37, "os", "a", 1),
    "class of no module": mark(37, "", "a", 1),
    "class of nothing": mark(37, f"{HERE}:", "a", 1),
    "factory that is a function": mark(35, f"{HERE}:is_same"),
    "factory that is another class": mark(35, "socket:socket"),
    "enum of a class": mark(36, f"{HERE}:Point", "x"),
    "enum without the member": mark(36, f"{HERE}:Level", "NONE"),
    "enum by value": mark(36, f"{HERE}:Level", 1),
    "slot that is not there": mark(37, f"{HERE}:FrozenSlotted", "b", 1),
    "struct without a field": mark(38, f"{HERE}:Reading"),
    "struct with another field": mark(38, f"{HERE}:Reading", "sensor", "s", "other", 1),
    "rows of no bytes": mark(54, "|V0", mark(1, 1), mark(34, 0)),
    "rows without a shape": mark(54, "<f8", mark(1), mark(34, 0)),
    "rows of a shape below zero": mark(54, "<f8", mark(1, -1), mark(34, 0)),
    "rows of a shape without an end": mark(54, "<f8", mark(10, 0, 10**12, 1), mark(34, 0)),
    "rows of objects": mark(54, "|O", mark(1, 1), mark(34, 0)),
    "rows of fields": mark(54, [[["a", "<f8", 0]], 8, False], mark(1, 1), mark(34, 0)),
    "rows of shapes below zero": mark(54, "<f8", mark(40, [-1]), mark(34, 0)),
    "rows of a shape that is none": mark(54, "<f8", [mark(10, 0, 10**12, 1)], mark(34, 0)),
    "rows of more bytes than there are": mark(54, "<f8", mark(40, [0], [1]), mark(34, 0)),
    "something beside the rows": mark(54, "<f8", mark(1, 1), mark(34, 0), 0, None),
    "something nowhere in the rows": mark(54, "<f8", mark(1, 1), mark(34, 0), 0),
    "tuples of texts": mark(40, "ab"),
    "ref without an address": mark(41, 7),
    "ref with more than an address": mark(41, "/app/a", "/app/b"),
    "tuple without a field": mark(39, f"{HERE}:Size", "height", 1),
}


@pytest.mark.parametrize("tree", FORGED.values(), ids=FORGED)
def test_forged_data_is_refused_at_once(tree: object) -> None:
    with pytest.raises(DamagedValue):
        decode_value(forged(tree))


GOLDEN = [
    (1, (2,), {3: {4}}, frozenset({5}), {(6,): 7}, OrderedDict(a=1), Counter("a"), deque([1], 2), bytearray(b"b"), 1j),
    [range(1, 5, 2), Decimal("1.0"), Fraction(1, 2), UUID(int=1), date(1, 2, 3), time(1, 2, 3, 4, UTC, fold=1), 2**64],
    [datetime(1, 2, 3, 4, 5, 6, 7, ZoneInfo("Asia/Tokyo")), timedelta(1, 2, 3), Path("p"), PurePosixPath("p"), None],
    [
        PureWindowsPath("p"),
        defaultdict(list, {1: [2]}),
        np.array([[1.5]], order="F"),
        np.str_("s"),
        np.bytes_(b"b"),
        2.5,
    ],
    [SafeUUID.safe, pstats.FunctionProfile("1", 2.0, 3.0, 4.0, 5.0, "f", 6), msgspec.inspect.IntType(gt=1)],
    [msgpack.ExtType(1, b"x"), np.zeros(1, [("a", "i2", 2)]), np.float32(1), UTC, "", True],
]
GOLDEN_DATA = (
    "010100000000000002ec989bc700010192c7000102810392c700020492c700030593c7000492c70001060793c70005a1610193c70006a161"
    "0193c70007020192c7000892c700220193c70009cb0000000000000000cb3ff00000000000009794c7000a01050292c7000ba3312e3093c7"
    "000c010293c7000dc41000000000000000000000000000000001c094c7000e01020397c7000f010102030492c7001294c70011000000c709"
    "00010000000000000000959ac70010000102030405060792c70013aa417369612f546f6b796f94c7001101020392c70014a17092c70015a1"
    "70c09692c70016a17094c70023ad6275696c74696e733a6c69737401910295c70030a33c663893c700010101a14392c700220892c70031a1"
    "7392c70031c40162cb40040000000000009393c70024ad757569643a5361666555554944a473616665dc0010c70025b67073746174733a46"
    "756e6374696f6e50726f66696c65a66e63616c6c73a131a7746f7474696d65cb4000000000000000af70657263616c6c5f746f7474696d65"
    "cb4008000000000000a763756d74696d65cb4010000000000000af70657263616c6c5f63756d74696d65cb4014000000000000a966696c65"
    "5f6e616d65a166ab6c696e655f6e756d626572069cc70026b76d7367737065632e696e73706563743a496e7454797065a26765c0a2677401"
    "a26c65c0a26c74c0ab6d756c7469706c655f6f66c09696c70027b36d73677061636b2e6578743a45787454797065a4636f646501a4646174"
    "61c4017895c70030939193a16192a33c693292c70001020004c292c7000101a14392c700220495c70030a33c663491c70001a092c7002204"
    "92c7001294c70011000000a0c393c700200092c7003493c7003284ad6269745f67656e657261746f72a55043473634a5737461746582a573"
    "74617465c71100009c5b484bfedb756c2a6e7d6f320fbc7ea3696e63c7110000922af2da2645f895a19857b95740937baa6861735f75696e"
    "74333200a875696e74656765720095c700330191c70001040092c700210062000000000000f83f000000000000803f"
)


def test_what_was_saved_in_format_1_can_be_read_for_ever() -> None:
    *result, generator, same = cast(list[Any], decode_value(bytes.fromhex(GOLDEN_DATA)))
    assert is_same(result, GOLDEN)
    assert generator is same
    assert generator.random() == np.random.Generator(np.random.PCG64(1)).random()


@pytest.mark.parametrize(
    "data", [b"", b"\1", b"\2\0\xc0", b"\0\0\xc0", b"\1\2\xc0", b"\1\0", b"\1\0\xc1", b"\1\0\xc0\xc0", b"\1\1", b"\x80"]
)
def test_what_is_no_saved_value_is_refused(data: bytes) -> None:
    with pytest.raises(DamagedValue):
        decode_value(data)


def test_unknown_format_is_named() -> None:
    with pytest.raises(DamagedValue, match=r"format 2\.0, and only format 1 is known"):
        decode_value(b"\2" + encode_value([1])[1:])


def test_data_may_be_any_buffer_of_bytes() -> None:
    data = encode_value((1, np.arange(3)))
    for buffer in (
        bytearray(data),
        memoryview(data),
        memoryview(b"xx" + data)[2:],
        memoryview(data).cast("b"),
    ):
        assert is_same(decode_value(buffer), (1, np.arange(3)))  # type: ignore[arg-type]


def test_every_cut_and_every_addition_is_noticed() -> None:
    for data in DATA[6:]:
        with pytest.raises(DamagedValue):
            decode_value(data + b"\0")
        for end in range(len(data)):
            with pytest.raises(DamagedValue):
                decode_value(data[:end])


@pytest.mark.filterwarnings("ignore")  # numpy on strange dtypes; as errors they would hide what comes after
def test_every_single_altered_byte_gives_a_value_or_a_damaged_value() -> None:
    chance = random.Random(0)
    for data in DATA:
        for index in range(len(data)) if len(data) < 200 else chance.sample(range(len(data)), 200):
            for byte in (0, 0xFF, data[index] ^ 1 << chance.randrange(8), chance.randrange(256)):
                read(data[:index] + bytes([byte]) + data[index + 1 :])


@pytest.mark.filterwarnings("ignore")
@settings(max_examples=1000)
@given(st.sampled_from(DATA), st.randoms(use_true_random=False))
def test_mutated_data_gives_a_value_or_a_damaged_value(data: bytes, chance: random.Random) -> None:
    altered = bytearray(data)
    for _ in range(chance.randint(1, 5)):
        start, length = chance.randrange(2, len(altered) + 1), chance.choice([0, 1, 1, 2, 5, 30])
        source = chance.choice(DATA)
        cut = chance.randrange(len(source))
        altered[start : start + length] = chance.choice(
            [chance.randbytes(length), source[cut : cut + length], source[cut : cut + 5], b""]
        )
    read(bytes(altered))


@settings(max_examples=500)
@given(st.binary(max_size=60), st.sampled_from([b"\1\0", b"\1\1\0\0\0\0\0\0\0\x20", b""]))
def test_random_bytes_give_a_value_or_a_damaged_value(data: bytes, head: bytes) -> None:
    read(head + data)


calls: list[object] = []
GRID = np.arange(3)


def Celsius(*arguments: object) -> None:
    calls.append(arguments)


class CelsiuX:
    def __new__(cls, *arguments: object) -> "CelsiuX":
        calls.append(arguments)
        return super().__new__(cls)


@dataclasses.dataclass
class Celsiux:
    degrees: int = 0


class CelsiuY(msgspec.Struct):
    degrees: int


@pytest.mark.parametrize(
    "name",
    [b"Celsius", b"CelsiuX", b"CelsiuY", b"nothing", b"calls.x", b"__doc__", b"pytest.", b".......", b"GRID.T\0"],
)
def test_class_must_be_there_and_of_the_saved_kind(name: bytes) -> None:
    data = encode_value(Celsiux(1))
    with pytest.raises(DamagedValue):
        decode_value(data.replace(b"Celsiux", name))
    with pytest.raises(DamagedValue):
        decode_value(encode_value(defaultdict(Celsiux)).replace(b"Celsiux", {b"CelsiuY": b"Celsius"}.get(name, name)))
    assert calls == []


@pytest.mark.parametrize("module", ["no.such.module", "os.path", "", ".", "os", "sys"])
def test_module_must_be_there(module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    name = f"{__name__}:Celsiux".encode()
    other = f"{module}:system".encode().ljust(len(name), b"x")[: len(name)]
    with pytest.raises(DamagedValue, match=r"is not there|is no class"):
        decode_value(encode_value(Celsiux(1)).replace(name, other))


def test_module_that_exits_when_imported_is_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = f"{__name__}:Celsiux"
    module = "quits".ljust(len(name) - 2, "_")
    (tmp_path / f"{module}.py").write_text("raise SystemExit(3)")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(DamagedValue, match="SystemExit: 3"):
        decode_value(encode_value(Celsiux(1)).replace(name.encode(), f"{module}:X".encode()))


def test_arrays_of_objects_are_never_made_from_bytes() -> None:
    data = encode_value(np.zeros(3))
    assert b"<f8" in data
    for dtype in (b"|O8", b"=O8", b"O,O", b"|T8"):
        with pytest.raises(DamagedValue):
            decode_value(data.replace(b"<f8", dtype))


@pytest.mark.parametrize(("kind", "field"), [("MT19937", "pos"), ("Philox", "buffer_pos")])
def test_generators_do_not_read_beside_their_memory(kind: str, field: str) -> None:
    data = encode_value(getattr(np.random, kind)(1))
    key = packed(field)
    start = data.index(key) + len(key)
    size = 3 if kind == "MT19937" else 1
    for position in (b"\xd1\xff\xff", b"\xd1\x7f\xff")[: 2 if size == 3 else 0] or (b"\xff", b"\x05"):
        with pytest.raises(DamagedValue, match="at position"):
            decode_value(data[:start] + position + data[start + size :])


def test_shape_must_fit_the_bytes() -> None:
    data = encode_value(np.zeros((3, 5), "i1"))
    shape = packed([msgpack.ExtType(1, b""), 3, 5])
    assert data.count(shape) == 1
    for other in ([15, 1], [5, 3]):
        decode_value(data.replace(shape, packed([msgpack.ExtType(1, b""), *other])))
    for other in ([3, 4], [0, 5], [-3, 5], [127, 127], [-1, -15]):
        with pytest.raises(DamagedValue):
            decode_value(data.replace(shape, packed([msgpack.ExtType(1, b""), *other])))


def test_errors_of_a_class_are_damage() -> None:
    data = encode_value(Picky(1))
    with pytest.raises(DamagedValue, match="ValueError: negative"):
        decode_value(data.replace(b"\xa1n\x01", b"\xa1n\xff"))


class Picky(msgspec.Struct):
    n: int

    def __post_init__(self) -> None:
        if self.n < 0:
            raise ValueError("negative")
