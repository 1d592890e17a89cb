"""Large lists and dicts are saved chunk by chunk: only what has changed, and whatever has changed (T9, T18)."""

from __future__ import annotations

import os
import random
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

import holdfast as hf
from holdfast.actors.values import ByteParts, encode_value
from holdfast.checkpoint.snapshot import entry_chunks
from holdfast.checkpoint.snapshot.image_parts import Chunk
from holdfast.checkpoint.snapshot.shared_blocks import (
    Digests,
    Layout,
    Segment,
    known_places,
    layout_of,
    memory_file,
    places_of,
    write_changed,
)
from holdfast.checkpoint.snapshot.state_image import Imager, read_image
from tests.checkpoint.ledger_player import Book, Order, Scan, Stock, state_of

ROUNDS = 40
SEEDS = 12 if "HOLDFAST_CROSSED" in os.environ else 5


class Images:
    """What a life does to save a state, without the life."""

    def __init__(self) -> None:
        self.imager = Imager()
        self.layout: Layout = {}
        self.begun: Layout = {}
        self.digests: Digests = {}
        self.segments: dict[int, Segment] = {}
        self.number = 0
        self.written = self.made = 0

    def take(self, state: dict[str, Any], *, is_kept: bool = True, remembers: bool = True) -> bytes:
        """Save a state; returns the bytes of its image."""
        self.number += 1
        pieces = self.imager.image(0, "keys", state, "x")
        self.made = sum(bool(piece.pieces) for _, piece in pieces if isinstance(piece, Chunk))
        known = self.layout or layout_of(pieces, self.begun)
        file = memory_file(self.number)
        layout = write_changed(file, self.number, pieces, known, self.segments, self.digests)
        if remembers:
            self.imager.remember()
        segment = Segment(self.number, file)
        segments = {**self.segments, self.number: segment}
        self.written = sum(length for number, _, length in places_of(layout) if number == self.number)
        data = b"".join(segments[number].block(at, length) for number, at, length in places_of(layout))
        if is_kept:
            self.layout, self.begun, self.segments = layout, {}, segments
        else:
            segment.close()
        return data

    def come_back(self, data: bytes) -> dict[str, Any]:
        """Begin another life with what the last one has saved."""
        places = places_of(self.layout)
        self.imager, self.layout, self.digests = Imager(), {}, {}
        self.begun = known_places(ByteParts([memoryview(data)]), places)
        return back(data)

    def restart(self) -> None:
        self.layout, self.begun, self.digests = {}, {}, {}

    def close(self) -> None:
        for segment in self.segments.values():
            segment.close()


def back(data: bytes) -> Any:
    return read_image(data)[2]


def alike(came: Any, state: Any) -> bool:
    """Whether two states are of equal types, values and ties; the order of variables says nothing."""
    return came.keys() == state.keys() and encode_value({name: came[name] for name in state}) == encode_value(state)


@pytest.fixture
def images() -> Any:
    made = Images()
    yield made
    made.close()


@pytest.fixture
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Many chunks of few entries, so that little has to be done until something lies at a border."""
    size = 512
    for name, value in (("LARGE", 1), ("_LOW", (1 << 32) // size), ("LEAST", size // 4), ("MOST", size * 4)):
        monkeypatch.setattr(entry_chunks, name, value)


@pytest.mark.usefixtures("small_chunks")
@pytest.mark.parametrize("seed", range(SEEDS))
@pytest.mark.some(3)
def test_whatever_is_done_to_it_comes_back_with_all_that_is_shared(images: Images, seed: int) -> None:
    print(f"seed {seed}")
    dice = random.Random(seed)
    book = Book(400)
    for number in range(ROUNDS):
        book.change(dice.randrange(10**9))
        state = state_of(book)
        data = images.take(state, is_kept=dice.random() < 0.8, remembers=dice.random() < 0.9)
        assert alike(back(data), state), f"seed {seed}, round {number}"
        match dice.randrange(20):
            case 0:
                images.restart()
            case 1:
                images.imager = Imager()  # As in a copy of the process, which forgets what it has seen.
            case 2 if images.layout:
                data = images.take(state)
                for name, value in images.come_back(data).items():
                    setattr(book, name, value)
            case _:
                pass


@pytest.mark.usefixtures("small_chunks")
@pytest.mark.parametrize("seed", range(5))
def test_who_remembers_nothing_finds_the_same_chunks(images: Images, seed: int) -> None:
    """So it is with a copy of the process that writes one image, and with the next life."""
    print(f"seed {seed}")
    dice = random.Random(seed)
    book = Book(400)
    for _ in range(20):
        book.change(dice.randrange(10**9))
        book.other = None
        images.take(state_of(book))
        images.imager = Imager()
        images.take(state_of(book))
        assert images.written < 2000, f"seed {seed}"


def size_of(state: Any) -> int:
    return len(encode_value(state))


@pytest.mark.parametrize("kind", [Scan, Order, Stock, tuple, str, int])
def test_of_a_list_that_grows_only_the_end_is_made_and_written(images: Images, kind: Any) -> None:
    make: Any = {
        Scan: lambda n: Scan(n / 8, f"scan {n}"),
        Order: lambda n: Order(n, "new", [n]),
        Stock: lambda n: Stock(f"part {n}", n),
        tuple: lambda n: (n, f"text {n}", (n,)),
        str: lambda n: f"text {n}",
        int: lambda n: 10**9 + n,
    }[kind]
    log = [make(n) for n in range(20_000)]
    data = images.take({"log": log, "n": 0})
    assert images.written >= size_of(log)
    for n in range(1, 20):
        log.append(make(20_000 + n))
        data = images.take({"log": log, "n": n})
        assert images.made <= 2
        assert images.written < 150_000
    assert alike(back(data), {"log": log, "n": 19})


@pytest.mark.parametrize("at", [0, 17_000, -1])
def test_what_is_put_in_or_taken_out_moves_nothing_else(images: Images, at: int) -> None:
    log = [Order(n, "new", [n]) for n in range(40_000)]
    images.take({"log": log})
    log.insert(at, Order(-1))
    images.take({"log": log})
    assert images.made <= 2
    assert images.written < 150_000
    del log[at]
    images.take({"log": log})
    assert images.made <= 2
    assert images.written < 150_000


def test_a_log_that_rolls_writes_its_two_ends(images: Images) -> None:
    log = [Scan(n / 8, "x" * 50) for n in range(20_000)]
    data = images.take({"log": log})
    for n in range(30):
        del log[0]
        log.append(Scan(n / 8, "y"))
        data = images.take({"log": log})
        assert images.made <= 3
        assert images.written < 250_000
    assert back(data) == {"log": log}


def test_of_a_dict_in_which_a_few_entries_change_only_their_chunks_are_made(images: Images) -> None:
    orders = {f"order-{n}": Order(n, "new", [{"line": n}]) for n in range(20_000)}
    data = images.take({"orders": orders})
    for n in range(20):
        one = orders[f"order-{n * 1000}"]
        one.lines[0]["line"] += 1
        one.state = "sent"
        orders[f"order-{n * 1000 + 500}"] = Order(n)
        data = images.take({"orders": orders})
        assert images.made <= 4
        assert images.written < 400_000
    assert alike(back(data), {"orders": orders})


def test_a_state_that_comes_back_unchanged_is_not_written_again(images: Images) -> None:
    book = Book(20_000)
    data = images.take(state_of(book))
    state = images.come_back(data)
    images.take(state)
    assert images.written < 1000
    state["log"].insert(10_000, "x")
    state["orders"]["order-77"].state = "sent"
    images.take(state)
    assert images.written < 300_000


@pytest.mark.parametrize("kind", ["state", "variables"])
def test_what_get_state_makes_anew_each_time_is_written_by_chunks_and_not_kept_alive(images: Images, kind: str) -> None:
    def made(n: int) -> Any:
        entries = [(f"key-{at}", at, [at]) for at in range(n)]
        return entries if kind == "state" else {"all": entries}

    for n in (20_000, 20_000, 20_001, 20_002):
        data = images.take(made(n))
        assert back(data) == made(n)
    assert images.written < 200_000
    (table,) = images.imager._tables.values()
    assert len(table.chunks) == 1, "enough to see whether the entries stay what they are"


def test_numbers_that_are_all_new_each_time_keep_their_chunks(images: Images) -> None:
    numbers: list[float] = []
    for n in range(4):
        numbers = [n + at / 8 for at in range(100_000)]
        assert back(images.take({"numbers": numbers})) == {"numbers": numbers}
    for _ in range(2):  # From the first of them on they are seen to stay.
        numbers[-1] += 1
        images.take({"numbers": numbers})
    assert images.written < 150_000


def test_arrays_in_entries_are_looked_at_each_time(images: Images) -> None:
    scans = [Order(n, lines=[np.full(200, n)]) for n in range(2000)]
    images.take({"scans": scans})
    scans[700].lines[0][5] = 1
    scans.append(Order(2000, lines=[np.zeros(200)]))
    data = images.take({"scans": scans})
    assert images.written < 200_000
    assert alike(back(data), {"scans": scans})


def test_what_only_a_part_of_the_entries_has_is_seen(images: Images) -> None:
    """What is kept beside the fields of a dataclass, and fields that were taken away."""
    orders = [Order(n) for n in range(20_000)]
    images.take({"orders": orders})
    vars(orders[5])["note"] = "x"
    del orders[9].state
    orders[11].__class__ = Other
    data = images.take({"orders": orders})
    assert alike(back(data), {"orders": orders})
    assert type(back(data)["orders"][11]) is Other
    assert images.written < 150_000


def test_what_went_from_one_entry_to_the_next_is_seen(images: Images) -> None:
    """All that the entries hold is the same, in the same order."""
    state: dict[str, Any] = {"rows": [[n, str(n)] for n in range(20_000)]}
    images.take(state)
    state["rows"][300].append(state["rows"][301].pop(0))
    assert alike(back(images.take(state)), state)


def test_a_tuple_that_holds_a_list_is_looked_into(images: Images) -> None:
    state: dict[str, Any] = {"rows": [(n, [n], Scan(0.0, "x")) for n in range(20_000)]}
    images.take(state)
    state["rows"][300][1].append("more")
    assert alike(back(images.take(state)), state)


class Other(Order):
    """A class that an order can become."""


def test_an_object_that_is_shared_by_ever_more_is_numbered_anew_where_it_stands(images: Images) -> None:
    orders = {n: Order(n, "new", [[n]]) for n in range(20_000)}
    state: dict[str, Any] = {"orders": orders, "late": [], "first": None}
    images.take(state)
    state["late"].append(orders[7])
    assert_shared(back(images.take(state)), late=7)
    state["late"].append(orders[7].lines)
    state["first"] = orders[7]  # It stands before the dict in the image.
    assert_shared(back(images.take(state)), late=7)
    assert images.written < 150_000
    del orders[7]
    came = back(images.take(state))
    assert came["late"][0] is came["first"]
    assert came["late"][1] is came["first"].lines
    state["late"].clear()
    came = back(images.take(state))
    assert came["first"].lines == [[7]]


def assert_shared(came: Any, late: int) -> None:
    assert came["late"][0] is came["orders"][late]
    assert all(one is came["orders"][late].lines for one in came["late"][1:])
    assert came["first"] in (None, came["orders"][late])


@pytest.mark.parametrize("other", [lambda log: log, lambda log: {"x": [log]}])
def test_a_list_that_stands_twice_is_one_again(images: Images, other: Any) -> None:
    log = [Order(n) for n in range(10_000)]
    images.take({"log": log, "same": None})
    came = back(images.take({"log": log, "same": other(log)}))
    assert alike(came, {"log": log, "same": other(log)})
    assert alike(back(images.take({"log": log, "same": 1})), {"log": log, "same": 1})


def test_what_cannot_be_saved_is_named_and_the_next_image_is_right(images: Images) -> None:
    orders: dict[str, Any] = {f"order-{n}": Order(n) for n in range(10_000)}
    images.take({"orders": orders, "n": 1})
    orders["order-500"].state = object()
    with pytest.raises(hf.errors.UnsavableValue, match=r"\['order-500'\]\.state: a value of type object"):
        images.take({"orders": orders, "n": 1})
    orders["order-500"].state = "good"
    orders["order-501"].lines.append(orders["order-501"])
    with pytest.raises(hf.errors.UnsavableValue, match="contains itself"):
        images.take({"orders": orders, "n": 1})
    orders["order-501"].lines.clear()
    orders["order-501"].lines.append(orders)
    with pytest.raises(hf.errors.UnsavableValue, match="contains itself"):
        images.take({"orders": orders, "n": 1})
    orders["order-501"].lines.clear()
    assert alike(back(images.take({"orders": orders, "n": 1})), {"orders": orders, "n": 1})


@dataclass
class Part:
    """An entry of a class that changes."""

    number: int


def test_entries_of_another_version_of_their_class_are_mapped(images: Images, monkeypatch: pytest.MonkeyPatch) -> None:
    parts = [Part(n) for n in range(10_000)]
    data = images.take({"parts": parts, "best": parts[3]})

    @hf.renamed(count="number")
    @dataclass
    class Later:
        count: int
        note: str = "none"

    Later.__qualname__ = "Part"
    monkeypatch.setattr(sys.modules[__name__], "Part", Later)
    came = back(data)
    assert came["parts"][:2] == [Later(0), Later(1)]
    assert came["best"] is came["parts"][3]
    images.take(came)
    assert images.written > 100_000, "all of them are written otherwise now"


def test_entries_that_are_all_alike_have_chunks_of_their_own(images: Images) -> None:
    log: list[Any] = ["the same text"] * 100_000
    for _ in range(3):
        assert back(images.take({"log": log})) == {"log": log}
        log.append("the same text")
    assert images.written < 150_000


def test_a_state_below_the_limit_has_no_chunks() -> None:
    pieces = Imager().image(0, "keys", {"log": [Order(n) for n in range(300)], "n": 1}, "x")
    assert not any(isinstance(piece, Chunk) for _, piece in pieces)


@pytest.mark.usefixtures("small_chunks")
def test_an_image_by_chunks_that_is_damaged_is_refused(images: Images) -> None:
    data = images.take({"log": [Order(n) for n in range(200)], "orders": {n: [n] for n in range(800)}})
    dice = random.Random(3)
    for size in (0, 5, 9, 30, len(data) // 2, len(data) - 1):
        with pytest.raises(hf.HoldfastError):
            read_image(data[:size])
    for _ in range(200):
        spoilt = bytearray(data)
        spoilt[dice.randrange(400)] ^= 1 << dice.randrange(8)
        try:
            read_image(bytes(spoilt))
        except hf.HoldfastError:
            pass
