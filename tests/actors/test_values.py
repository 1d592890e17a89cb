"""Values come back with their types, or are refused by name; damaged bytes never do anything else than say so."""

import contextlib
import dataclasses
import enum
import math
import os
import pstats
import random
import socket
import struct
import subprocess
import sys
import time as clock
import tracemalloc
import types
from collections import Counter, OrderedDict, UserDict, defaultdict, deque
from collections.abc import Callable
from datetime import UTC, date, datetime, time, timedelta, timezone, tzinfo
from decimal import Decimal, localcontext
from fractions import Fraction
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar, cast
from uuid import UUID, SafeUUID, uuid1
from zoneinfo import ZoneInfo

import msgpack
import msgspec
import msgspec.inspect
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from holdfast.actors.values import DamagedValue, UnsavableValue, decode_value, encode_value, state_digest

T = TypeVar("T")
HERE = __name__


class Colour(enum.Enum):
    RED = "r"
    CRIMSON = "r"  # noqa: PIE796 - an alias, on purpose
    COMPUTE = (len,)  # a value that could not be saved; the name can


class Level(enum.IntEnum):
    LOW = 1
    HIGH = 2


class Word(enum.StrEnum):
    YES = "yes"


class Access(enum.Flag):
    READ = 1
    WRITE = 2
    RUN = 4


class Bits(enum.IntFlag):
    A = 1
    B = 2


@dataclasses.dataclass
class Point:
    x: int = 0
    y: Any = 0
    made: ClassVar[int] = 0

    def __post_init__(self) -> None:
        type(self).made += 1


@dataclasses.dataclass(frozen=True)
class Frozen:
    name: str
    tags: frozenset[str] = frozenset()


@dataclasses.dataclass(slots=True)
class Slotted:
    a: int
    _b: list[int] = dataclasses.field(default_factory=list)


@dataclasses.dataclass(frozen=True, slots=True, order=True)
class FrozenSlotted:
    a: int


@dataclasses.dataclass
class Base:
    __slots__ = ("__hidden", "a")
    a: int

    def hide(self, value: object) -> None:
        self.__hidden = value

    def shown(self) -> object:
        return self.__hidden


@dataclasses.dataclass
class Derived(Base):
    b: int = 2


@dataclasses.dataclass(eq=False)
class Node:
    next: "Node | None" = None


@dataclasses.dataclass
class Box(Generic[T]):
    content: T


@dataclasses.dataclass
class RichDict(dict[str, int]):
    note: str = ""


class Outer:
    @dataclasses.dataclass
    class Inner:
        a: int


class Reading(msgspec.Struct, frozen=True):
    sensor: str
    values: tuple[float, ...] = ()


class Loose(msgspec.Struct, dict=True, kw_only=True, rename="camel"):
    some_field: int
    other: list[int] = msgspec.field(default_factory=list)


class Counted(msgspec.Struct):
    n: int

    def __post_init__(self) -> None:
        self.n += 1


class Size(NamedTuple):
    width: int
    height: Any = 0


class NotedSize(Size):
    """With a `__dict__`."""


class MyList(list[int]): ...


class MyDict(dict[str, int]): ...


class MyTuple(tuple[int, ...]): ...


class MyInt(int): ...


class MyFloat(float): ...


class MyStr(str): ...


class MyBytes(bytes): ...


class MySet(set[int]): ...


class MyDate(date): ...


class MyZone(tzinfo):
    def utcoffset(self, when: datetime | None) -> timedelta:
        return timedelta(0)

    dst = utcoffset

    def tzname(self, when: datetime | None) -> str:
        return "mine"


def is_same(a: Any, b: Any) -> bool:
    """Equal in type and content, all the way down; nothing of values.py is used for it."""
    if type(a) is not type(b):
        return False
    if type(a).__module__ == "numpy" and a.dtype.names:
        return (a.dtype, a.shape) == (b.dtype, b.shape) and all(is_same(a[name], b[name]) for name in a.dtype.names)
    if type(a) is np.longdouble:  # has bytes without meaning
        return bool(a == b)
    if isinstance(a, np.ndarray):
        return (
            a.dtype == b.dtype
            and a.dtype.char == b.dtype.char
            and a.shape == b.shape
            and np.ascontiguousarray(a).tobytes() == np.ascontiguousarray(b).tobytes()
        )
    if isinstance(a, np.generic):
        return a.dtype == b.dtype and a.tobytes() == b.tobytes()
    if isinstance(a, enum.Enum):
        return a is b
    if isinstance(a, float):
        return struct.pack("d", a) == struct.pack("d", b)
    if isinstance(a, complex):
        return is_same([a.real, a.imag], [b.real, b.imag])
    if isinstance(a, dict):
        return is_same([*a.items()], [*b.items()]) and (
            not isinstance(a, defaultdict) or a.default_factory is b.default_factory
        )
    if isinstance(a, (list, tuple, deque)):
        return (
            len(a) == len(b)
            and getattr(a, "maxlen", None) == getattr(b, "maxlen", None)
            and all(map(is_same, a, b))
            and is_same(getattr(a, "__dict__", None), getattr(b, "__dict__", None))
        )
    if isinstance(a, (set, frozenset)):
        return len(a) == len(b) and all(any(is_same(x, y) for y in b) for x in a)
    if isinstance(a, Decimal):
        return a.as_tuple() == b.as_tuple()
    if isinstance(a, (datetime, time)):
        return a.replace(tzinfo=None) == b.replace(tzinfo=None) and a.fold == b.fold and is_same(a.tzinfo, b.tzinfo)
    if isinstance(a, timezone):
        return a == b and a.tzname(None) == b.tzname(None)
    if isinstance(a, ZoneInfo):
        return a is b
    if isinstance(a, random.Random):
        return a.getstate() == b.getstate()
    if dataclasses.is_dataclass(a) or isinstance(a, msgspec.Struct):
        names = getattr(a, "__struct_fields__", ()) or getattr(a, "__dataclass_fields__", ())
        return is_same([getattr(a, name) for name in names], [getattr(b, name) for name in names])
    return bool(a == b)


def again(value: Any) -> Any:
    return decode_value(encode_value(value))


VALUES: list[object] = [
    None, True, False, 0, 1, -1, 2**63 - 1, -(2**63), 2**64 - 1, 2**64, -(2**63) - 1, 2**70, -(2**70), 10**5000,
    0.0, -0.0, 1.0, 1.5, math.inf, -math.inf, math.nan, 5e-324,
    "", "text", "é\0\n", "\ud800 lone", "\U0001f600", b"", b"\0\xff", bytearray(), bytearray(b"ab\0"),
    [], [[]], {}, (), ((),), set(), frozenset(), [1, 1.0, True], (1, (2, [3, (4,)])), [(), [], {}, set()],
    {1, 2}, {1.0, "1", b"1", (1,), frozenset({1}), None}, frozenset({frozenset(), 2**80}),
    {"a": 1, "b": [2]}, {2: "a", 1: "b"}, {True: 1, 2.5: 2, None: 3, b"k": 4, "s": 5}, {(1, (2,)): {(3,): ()}},
    {frozenset({1}): 1, Decimal(1) / 3: 2, date(2020, 1, 1): 3}, {2**100: 2**100},
    {Level.LOW: Level.HIGH, 7: Colour.RED},
    {Frozen("k"): [Frozen("v")]}, {Reading("k"): 1}, {math.inf: 1, math.nan: 2},
    deque(), deque([1, (2,)]), deque([1, 2], maxlen=2), deque(maxlen=0),
    defaultdict(None, {1: 2}), defaultdict(list, {"a": [1]}), defaultdict(int),
    defaultdict(Counter, {(1,): Counter("ab")}),
    defaultdict(Point), defaultdict(bool, {"k": True}), defaultdict(float),
    OrderedDict([("b", 1), ("a", 2)]), OrderedDict({(1,): [OrderedDict()]}), Counter("hello"),
    Counter({"a": -1, (1,): 0}),
    1j, complex(-0.0, math.nan), range(0), range(1, 10, 3), range(10**30, 0, -(10**28)),
    Decimal("1.10"), Decimal("-0"), Decimal("NaN"), Decimal("sNaN123"), Decimal("-Infinity"), Decimal("1E+999999"),
    Fraction(1, 3), Fraction(-(10**40), 7), UUID(int=5), uuid1(),
    date.min, date.max, datetime.min, datetime(2024, 2, 29, 1, 2, 3, 4), datetime(2024, 1, 1, tzinfo=UTC),
    datetime(2024, 10, 27, 2, 30, fold=1, tzinfo=ZoneInfo("Europe/Berlin")),
    datetime(1, 1, 1, tzinfo=timezone(timedelta(hours=1))),
    datetime(2024, 1, 1, tzinfo=timezone(timedelta(hours=-5, microseconds=1), "odd")), time(23, 59, 59, 999999, fold=1),
    time(1, tzinfo=UTC), timedelta.max, timedelta(-1, 2, 3), UTC, timezone(timedelta(0), "Z"), ZoneInfo("Asia/Tokyo"),
    Path(), Path("/tmp/x"), Path("a/../b\udcff"), PurePosixPath("//x"), PureWindowsPath(r"c:\a"),
    Colour.RED, Colour.CRIMSON, Colour.COMPUTE, Level.HIGH, Word.YES, Access.READ, Access.READ | Access.RUN, Access(0),
    Bits(3), Bits(8),
    Point(1, [2]), Frozen("a", frozenset({"b"})), Slotted(1, [2]), FrozenSlotted(1), Derived(1, 3),
    Box({1: Box((2,))}), Outer.Inner(1),
    Reading("a", (1.0,)), Loose(some_field=1), Size(1, [2]), NotedSize(1), msgpack.ExtType(1, b"x"),
]  # fmt: skip


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


# Refusals.


def cyclic_list() -> object:
    value: list[Any] = [1]
    value.append({"k": (value,)})
    return value


def cyclic_node() -> object:
    value = Node()
    value.next = Node(value)
    return value


def local_class() -> object:
    @dataclasses.dataclass
    class Local:
        a: int

    return Local(1)


def imposter() -> object:
    made = dataclasses.make_dataclass("Point", ["x"])
    made.__module__ = HERE
    return made(1)


REFUSED: list[tuple[Any, str]] = [
    (lambda: {"x": [1, 2, 3, {"socket": len}]}, "['x'][3]['socket']: a value of type builtin_function_or_method"),
    (object, ": a value of type object"),
    (lambda: [test_value_returns_with_its_type], "[0]: a value of type function"),
    (lambda: (1, [types]), "[1][0]: a value of type module"),
    (lambda: [int], "[0]: a value of type type"),
    (lambda: {"a": slice(1)}, "['a']: a value of type slice"),
    (lambda: [...], "[0]: a value of type ellipsis"),
    (lambda: [memoryview(b"x")], "[0]: a value of type memoryview"),
    (lambda: {memoryview(b"x"): 1}, ".keys()[0]: a value of type memoryview"),
    (lambda: [msgpack.Timestamp(1)], "[0]: a value of type msgpack.ext.Timestamp"),
    (lambda: [ValueError("x")], "[0]: a value of type ValueError"),
    (lambda: deque([1, object()]), "[1]: a value of type object"),
    (lambda: {1, (2, object())}, "{...}[1]: a value of type object"),
    (lambda: {(1, object()): 2}, ".keys()[0][1]: a value of type object"),
    (lambda: {(1,): 2, (2,): object()}, "[(2,)]: a value of type object"),
    (lambda: {"k" * 1000: object()}, "['kkkkkkkkkkkk...kkkkkkkkkkkkk']: a value of type object"),
    (lambda: OrderedDict(a=object()), "['a']: a value of type object"),
    (lambda: defaultdict(list, {1: object()}), "[1]: a value of type object"),
    (lambda: [defaultdict(lambda: 1)], "[0].default_factory: a value of type function"),
    (lambda: defaultdict(socket.socket), ".default_factory: a value of type type"),
    (lambda: [Point(1, [object()])], "[0].y[0]: a value of type object"),
    (lambda: Slotted(1, object()), "._b: a value of type object"),  # type: ignore[arg-type]
    (lambda: Loose(some_field=1, other=object()), ".other: a value of type object"),  # type: ignore[arg-type]
    (lambda: Size(1, object()), ".height: a value of type object"),
    (lambda: MyList([1]), f": a value of type {HERE}.MyList"),
    (lambda: [MyDict()], f"[0]: a value of type {HERE}.MyDict"),
    (lambda: [MyTuple()], f"[0]: a value of type {HERE}.MyTuple"),
    (lambda: [MyInt(1)], f"[0]: a value of type {HERE}.MyInt"),
    (lambda: [MyFloat(1)], f"[0]: a value of type {HERE}.MyFloat"),
    (lambda: [MyStr("x")], f"[0]: a value of type {HERE}.MyStr"),
    (lambda: {MyStr("x"): 1}, f".keys()[0]: a value of type {HERE}.MyStr"),
    (lambda: [MyBytes(b"x")], f"[0]: a value of type {HERE}.MyBytes"),
    (lambda: [MySet()], f"[0]: a value of type {HERE}.MySet"),
    (lambda: [MyDate(2020, 1, 1)], f"[0]: a value of type {HERE}.MyDate"),
    (lambda: [datetime(2020, 1, 1, tzinfo=MyZone())], f"[0].tzinfo: a value of type {HERE}.MyZone"),
    (lambda: [random.SystemRandom()], "[0]: a value of type random.SystemRandom"),
    (lambda: [RichDict(note="n")], f"[0]: a value of type {HERE}.RichDict"),
    (lambda: UserDict(a=1), ": a value of type collections.UserDict"),
    (lambda: types.MappingProxyType({}), ": a value of type mappingproxy"),
    (lambda: clock.gmtime(0), ": a value of type time.struct_time"),
    (lambda: [local_class()], f"[0]: a value of type {HERE}.local_class.<locals>.Local, whose class is not found"),
    (lambda: [imposter()], f"[0]: a value of type {HERE}.Point, whose class is not found"),
    (cyclic_list, "[1]['k'][0]: a list that contains itself"),
    (cyclic_node, f".next.next: a {HERE}.Node that contains itself"),
    (lambda: [np.array([object()])], "[0]: a numpy value of dtype object"),
    (lambda: [np.zeros(1, [("a", "O")])], "[0]: a numpy value of dtype object"),
    (lambda: np.array(["a"], np.dtypes.StringDType()), ": a numpy value of dtype StringDType()"),
    (lambda: [np.zeros(1, [("a", "i4")]).view(np.recarray)], "[0]: a value of type numpy.rec.recarray"),
    (lambda: np.zeros(1, np.dtype((np.record, [("a", "i4")]))),
     ": a numpy value of dtype (numpy.record, [('a', '<i4')])"),
    (lambda: np.ma.masked_array([1], [True]), ": a value of type numpy.ma.MaskedArray"),
    (lambda: np.zeros(1, np.dtype("i4", metadata={"a": 1})), ": a numpy value of dtype int32"),
    (lambda: [np.random.RandomState(np.random.PCG64(1))], "[0]: a value of type numpy.random.mtrand.RandomState"),
    (lambda: [np.dtype("i4")], "[0]: a value of type numpy.dtypes.Int32DType"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "text"), REFUSED, ids=[text for _, text in REFUSED])
def test_refusal_names_what_and_where(make: Callable[[], object], text: str) -> None:
    value = make()
    for encode in (
        lambda: encode_value(value, where="self.balance"),
        lambda: encode_value([1, value], where="self.balance"),
    ):
        with pytest.raises(UnsavableValue) as caught:
            encode()
        assert text.lstrip(":") in str(caught.value)
        assert str(caught.value).startswith("self.balance")
        assert "cannot be saved; make it a key variable of a supported type" in str(caught.value)
    with pytest.raises(UnsavableValue) as caught:
        encode_value(value, where="self.balance")
    if not text.startswith("{"):
        assert str(caught.value).startswith(f"self.balance{text}")


def test_refusal_is_found_behind_what_is_shared_deeper() -> None:
    shared = [1]
    with pytest.raises(UnsavableValue, match=r"^value\[2\]: a value of type object"):
        encode_value([[[[shared]]], [[[shared]]], object()])


def test_bytearray_can_grow_while_the_refusal_is_kept() -> None:
    buffer = bytearray(b"x")
    with pytest.raises(UnsavableValue) as caught:
        encode_value([buffer, buffer, object()])
    buffer.append(1)
    assert caught.value.where == "value[2]"


def test_dict_of_an_object_is_seen_through() -> None:
    box = Box(bytearray(b"x"))
    assert is_same(again([vars(box), 1]), [{"content": bytearray(b"x")}, 1])


def test_refusal_says_what_to_do() -> None:
    with socket.socket() as used, pytest.raises(UnsavableValue) as caught:
        encode_value({"x": [0, 1, 2, Box(used)]}, where="balance")
    assert str(caught.value) == (
        "balance['x'][3].content: a value of type socket.socket cannot be saved; make it a key variable of a supported "
        "type, name it with a leading underscore, or define get_state/set_state"
    )
    assert UnsavableValue(*caught.value.args) == caught.value or str(UnsavableValue(*caught.value.args)) == str(
        caught.value
    )


def content(value: Any) -> Any:
    return value.next if isinstance(value, Node) else next(iter(value.values() if isinstance(value, dict) else value))


@pytest.mark.parametrize(
    "wrap", [lambda x: [x], lambda x: {"k": x}, lambda x: (x,), Node], ids=["list", "dict", "tuple", "dataclass"]
)
def test_deep_nesting_returns_or_is_refused(wrap: Callable[[Any], Any]) -> None:
    value: Any = None
    for _ in range(100):
        value = wrap(value)
    depth, result = 0, again(value)
    while result is not None:
        result, depth = content(result), depth + 1
    assert depth == 100
    for _ in range(100_000):
        value = wrap(value)
    with pytest.raises(UnsavableValue, match=r"^v: a value that is nested too deep"):
        encode_value(value, where="v")
    while value is not None:  # freed one by one: the interpreter would do it recursively
        value = content(value)


def test_long_path_is_cut_in_the_middle() -> None:
    value: Any = object()
    for index in range(100):
        value = [value] if index else {"end": value}
    with pytest.raises(UnsavableValue) as caught:
        encode_value(value)
    assert caught.value.where.startswith("value[0][0][0]")
    assert caught.value.where.endswith("[0][0]['end']")
    assert len(caught.value.where) < 250


# numpy.

BASE = np.arange(24, dtype="f4").reshape(2, 3, 4)
POINT = np.dtype([("x", "<f4"), ("name", "U3"), ("at", "<M8[ms]"), ("m", "i2", (2, 2))])
ARRAYS = [
    BASE, np.asfortranarray(BASE), BASE.T, BASE[:, ::2], BASE[::-1, 1:], BASE.astype(">f8"),
    np.broadcast_to(BASE, (2, 2, 3, 4)),
    np.array(5), np.array(1 + 2j, "c8"), np.zeros((0, 3)), np.zeros((3, 0), order="F"), np.array([]),
    np.array([True, False]), np.arange(3, dtype="q"),
    np.array(["a", "bcd\0é"]), np.array([b"a\0", b"bc"]), np.array(["2020-01-01", "NaT"], "M8[D]"),
    np.array([1, -1], "m8[25us]"),
    np.array([b"abc"], "V5"), np.zeros(2, "V0"), np.zeros(2, "U0"), np.array([1.5], "f2"), np.array([1, np.nan], "g"),
    np.array([1j], "G"),
    np.zeros(2, POINT), np.array([(1.0, "abc", "2020-01-01", [[1, 2], [3, 4]])], POINT)[::-1],
    np.ones(2, np.dtype([("a", "i1"), ("b", "f8"), ("c", [("d", ">u2")])], align=True)), np.zeros((), "i4,f8"),
    np.zeros(3, []),
    np.ones(2, np.dtype({"names": ["a", "b"], "formats": ["i4", "f8"], "offsets": [8, 0], "itemsize": 24})),
    np.ones(2, [(("title", "a"), "i4"), ("b", "q")]), np.ones(2, [("a", "i4"), ("b", "i2"), ("c", "f8")])[["c", "a"]],
]  # fmt: skip


@pytest.mark.parametrize("array", ARRAYS, ids=lambda array: f"{array.dtype.str} {array.shape} {array.strides}")
def test_array_returns_writable_with_memory_of_its_own(array: Any) -> None:
    before = array.copy()
    for result in (again(array), again({"a": [1, array]})["a"][1]):
        assert is_same(result, array)
        assert result.dtype.fields == array.dtype.fields
        assert result.dtype.isalignedstruct == array.dtype.isalignedstruct
        assert result.flags.writeable
        assert result.flags.owndata
        assert result.flags.aligned
        if array.flags.forc:
            assert result.flags.f_contiguous == array.flags.f_contiguous
        if result.size and result.dtype.itemsize:
            result[...] = np.zeros((), result.dtype)
    assert is_same(array, before)


SCALARS = [
    np.float64(0.1), np.float32(math.nan), np.float16(1), np.longdouble("0.1"), np.complex64(1j), np.int8(-1),
    np.int64(1), np.longlong(1),
    np.uint64(2**64 - 1), np.bool_(True), np.str_("a\0"), np.str_(""), np.bytes_(b"a\0"), np.bytes_(b""),
    np.datetime64("2020-01-01T00:00:00.5"),
    np.datetime64("NaT"), np.timedelta64(3, "h"), np.void(b"a\0"), np.ones(1, POINT)[0],
]  # fmt: skip


@pytest.mark.parametrize("scalar", SCALARS, ids=lambda scalar: type(scalar).__name__)
def test_numpy_scalar_returns_with_its_type(scalar: Any) -> None:
    assert is_same(again(scalar), scalar)
    if not isinstance(scalar, np.void):
        assert is_same(again({scalar: (scalar,)}), {scalar: (scalar,)})


@pytest.mark.parametrize("kind", ["PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64"])
def test_numpy_generator_goes_on_where_it_was(kind: str) -> None:
    generator = np.random.Generator(getattr(np.random, kind)(np.random.SeedSequence([1, 2**70], spawn_key=(3,))))
    generator.integers(10, size=3, dtype="u4")  # leaves half a word in the buffer
    generator.spawn(1)
    result = again(generator)
    assert type(result.bit_generator) is type(generator.bit_generator)
    for draw in (
        lambda g: g.integers(100, size=700, dtype="u4"),
        lambda g: g.normal(size=5),
        lambda g: g.spawn(2)[1].random(3),
    ):
        assert draw(result).tolist() == draw(generator).tolist()


@pytest.mark.parametrize("seed", [None, 3, np.int64(3), [1, 2**40], (1, 2), np.array([1, 2])], ids=repr)
def test_generator_keeps_the_seed_it_spawns_from(seed: Any) -> None:
    generator = np.random.default_rng(seed)
    assert again(generator).spawn(1)[0].random(3).tolist() == generator.spawn(1)[0].random(3).tolist()


def test_generators_over_one_source_stay_together() -> None:
    source = np.random.PCG64(1)
    first, second = again([np.random.Generator(source), np.random.Generator(source)])
    expected = np.random.Generator(np.random.PCG64(1)).random(2)
    assert [first.random(), second.random()] == expected.tolist()


def test_random_state_and_random_go_on_where_they_were() -> None:
    for old, draw in (
        (np.random.RandomState(1), lambda r: r.normal(size=7).tolist()),
        (random.Random(1), lambda r: [r.gauss(0, 1) for _ in range(7)]),
    ):
        draw(old)  # an odd number: one normal deviate is left over
        assert draw(again(old)) == draw(old)


def test_numpy_is_imported_for_arrays_only() -> None:
    program = (
        "import sys; from holdfast.actors.values import encode_value, decode_value\n"
        "data = encode_value({'a': (1, {2}, 3j)}); decode_value(data); assert 'numpy' not in sys.modules\n"
        f"assert decode_value(bytes.fromhex('{encode_value(np.arange(3)).hex()}')).tolist() == [0, 1, 2]"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


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


# Damage.

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
    "factory that is a function": mark(35, f"{HERE}:forged"),
    "factory that is another class": mark(35, "socket:socket"),
    "enum of a class": mark(36, f"{HERE}:Point", "x"),
    "enum without the member": mark(36, f"{HERE}:Level", "NONE"),
    "enum by value": mark(36, f"{HERE}:Level", 1),
    "slot that is not there": mark(37, f"{HERE}:FrozenSlotted", "b", 1),
    "struct without a field": mark(38, f"{HERE}:Reading"),
    "struct with another field": mark(38, f"{HERE}:Reading", "sensor", "s", "other", 1),
    "tuple without a field": mark(39, f"{HERE}:Size", "width", 1),
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
    [b"Celsius", b"CelsiuX", b"CelsiuY", b"nothing", b"calls.x", b"__doc__", b"pytest.", b".......", b"BASE.T\0"],
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
    name = f"{HERE}:Celsiux".encode()
    other = f"{module}:system".encode().ljust(len(name), b"x")[: len(name)]
    with pytest.raises(DamagedValue, match=r"is not there|is no class"):
        decode_value(encode_value(Celsiux(1)).replace(name, other))


def test_module_that_exits_when_imported_is_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = f"{HERE}:Celsiux"
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
