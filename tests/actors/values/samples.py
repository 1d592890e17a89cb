"""Values to save, of classes that can be found and of some that cannot, and how to tell whether two are the same."""

import dataclasses
import enum
import math
import random
import struct
from collections import Counter, OrderedDict, defaultdict, deque
from datetime import UTC, date, datetime, time, timedelta, timezone, tzinfo
from decimal import Decimal
from fractions import Fraction
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar
from uuid import UUID, uuid1
from zoneinfo import ZoneInfo

import msgpack
import msgspec
import numpy as np

from holdfast.actors.values import decode_value, encode_value

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
    """Equal in type and content, all the way down; nothing of `holdfast` is used for it."""
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
SCALARS = [
    np.float64(0.1), np.float32(math.nan), np.float16(1), np.longdouble("0.1"), np.complex64(1j), np.int8(-1),
    np.int64(1), np.longlong(1),
    np.uint64(2**64 - 1), np.bool_(True), np.str_("a\0"), np.str_(""), np.bytes_(b"a\0"), np.bytes_(b""),
    np.datetime64("2020-01-01T00:00:00.5"),
    np.datetime64("NaT"), np.timedelta64(3, "h"), np.void(b"a\0"), np.ones(1, POINT)[0],
]  # fmt: skip
