"""Samples: the entries, addresses, keys and blocks that engines are tried with."""

from __future__ import annotations

import random
from typing import Any, Final

from ...checkpoint.journal import Entry
from ...checkpoint.snapshot.shared_blocks import BLOCK, PAGE

STRANGE: Final[list[Entry]] = [
    ("in", 0, -1, 1, 2**31, 2**63 - 1, 2**63, 2**64, -(2**63), -(2**63) - 1, -(2**90), 10**400, 255, -129),
    ("in", 0.0, -0.0, 1.5, 1e300, 5e-324, float("inf"), float("-inf"), float("nan"), 1.0, 0.1),
    ("in", True, False, None, 1, 0, "", b"", ()),
    ("in", "é\U0001f600", "\ud800", "e\u0301", "a\0b", "\r\n", " x ", "X" * 300, "1", "None"),
    ("in", bytes(range(256)), b"text", b"\xff\xfe", b"\0" * 40),
    ("in", ((1, (2, "x")), None), ((),), (((((0,),),),),), (True, (1,)), ("in", 1)),
    ("",),
    ("a kind with a long name " * 10, 1),
    ("out", "x" * 100_000, b"y" * 1_000_000),
]
"""What must come back as it was, types included."""

NO_ENTRIES: Final[list[Any]] = [
    ("in", [1]),
    ("in", {}),
    ("in", {1}),
    ("in", object()),
    ("in", bytearray(b"x")),
    ("in", memoryview(b"x")),
    ("in", 1j),
    ("in", (1, (2, [3]))),
    ("in", ...),
    (),
    [1],
    "in",
    None,
]
"""What no engine may take."""


class OtherText(str):
    """A `str` of another type."""

    __slots__ = ()


class Number(int):
    """An `int` of another type."""


SUBCLASSES: Final[list[Entry]] = [
    ("in", OtherText("x")),
    ("in", Number(1)),
    (OtherText("in"), 1),
    ("in", (1, Number(2))),
]
"""What is either refused, or comes back with its types."""

ADDRESSES: Final = (
    "/app/a", "/app/b", "/app/a/b", "/app/ab", "/app/A", "/app/a ", "/app/a\0b", "/app/a\0", "/app/é", "/app/e\u0301",
    "/app/%", "/app/_", "/app/*", "/app/?", "/app/[a]", "/app/'\"", "/app/a\nb", "/app/../a", "/app/a/", "/app//a",
    "/app/\U0001f600", "/app/" + "x" * 3000, "/app/" + "x" * 3000 + "y", "/app", "0", "-1", "/app/a.new",
    "/app/\U0010ffff",
)  # fmt: skip
"""Addresses that are easily taken for each other."""

KEYS: Final = (
    "child a", "child b", "child ", "child", "child ab", "child A", "Child a", "CHILD A", "child a\0", "child a\0b",
    "child %", "child _", "c%", "c_ild a", "child *", "child ?", "child [a]", "child \U0010ffff", "child \U0010ffffx",
    "child é", "child e\u0301", "other", "", " ", "'", "x" * 3000, "x" * 3000 + "y", "1", "1.0", "child a\n",
    "/app/a", "/app/b", "/app/a/b", "in", "epoch", "last",
)  # fmt: skip
"""Keys of notes, each of which is a prefix to ask for as well."""


def make_entry(draw: random.Random) -> Entry:
    """An entry as the switch writes them, mostly short."""
    number = draw.randrange(1000)
    choice = draw.randrange(8)
    if choice < 5:
        return ("in", number, draw.randbytes(draw.randrange(40)))
    if choice == 5:
        return ("out", number, "x" * draw.randrange(2000))
    return draw.choice(STRANGE[:-1])


def make_blocks(draw: random.Random) -> list[tuple[int, memoryview]]:
    """Blocks as a large snapshot has them: at multiples of a page, the last one of any length."""
    pieces = (bytes(BLOCK), draw.randbytes(BLOCK), b"ab" * (PAGE // 2), draw.randbytes(PAGE + 5))
    places = (0, BLOCK, 2 * BLOCK + 3 * PAGE, 3 * BLOCK)
    return [(offset, memoryview(bytearray(piece))) for offset, piece in zip(places, pieces, strict=True)]


def make_small_blocks(draw: random.Random) -> list[tuple[int, memoryview]]:
    """A few short ones."""
    return [(n * PAGE, memoryview(bytearray(draw.randbytes(draw.randrange(1, 900))))) for n in range(3)]
