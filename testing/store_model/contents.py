"""Promises about what a store holds: each function tries one on a bench, and raises `PromiseBroken` if it fails."""

from __future__ import annotations

import array
import functools
import importlib.util
import random
from collections.abc import Callable, Sequence
from typing import Any, Final

from ...checkpoint.journal import DamagedStore, Entry, Saved
from ...checkpoint.snapshot.shared_blocks import PAGE
from .bench import Bench, OpenEngine
from .comparing import PromiseBroken, expect, refused, same
from .model import StoreModel, check_pack
from .samples import ADDRESSES, KEYS, NO_ENTRIES, STRANGE, SUBCLASSES, make_blocks, make_small_blocks
from .writes import A, B, append, cut, erase, fill, forget_blocks, keep_blocks, note

LARGE: Final = 3 << 20
"""Bytes of a large value."""
MANY_ENTRIES: Final = 1500
"""Entries of a large batch."""
MANY_ADDRESSES: Final = 2000
MANY_NOTES: Final = 300
MANY_PACKS: Final = 70
MANY_OPENINGS: Final = 20


def check_twice(opened: OpenEngine, model: StoreModel, **more: Sequence[str]) -> None:
    """Compare now, and after another opening."""
    model.check(opened.journal, **more)
    opened.reopen()
    model.check(opened.journal, **more)


# ---- entries


def a_new_store_is_empty(bench: Bench) -> None:
    """It knows no address and no note, and has nothing of an unknown one."""
    opened = bench.open()
    StoreModel().check(opened.journal, others=[A, ""], prefixes=["key"])
    if opened.journal.durable is not True:
        raise PromiseBroken(f"durable is {opened.journal.durable!r}, not True")
    expect(opened.journal.append([]), [], "append of nothing")
    refused(lambda: opened.journal.read_blocks(A, 1, [(0, PAGE)]), "read_blocks of nothing", DamagedStore)
    check_twice(opened, StoreModel(), others=[A])


def positions_rise_over_everything(bench: Bench) -> None:
    """Over all addresses, cuts, erasures and openings: no position is ever handed out twice."""
    opened, model = bench.open(), StoreModel()
    for _ in range(3):
        journal = opened.journal
        append(journal, model, (A, ("in", 1)), (B, ("in", 2)), (A, ("in", 3)))
        append(journal, model, (B, ("in", 4)))
        model.check(journal)
        cut(journal, model, B, b"", list(model.places[B].entries), turn=1, keep=1)
        erase(journal, model, A)
        append(journal, model, (A, ("in", 5)))
        cut(journal, model, A, b"", list(model.places[A].entries), turn=1, keep=1)
        cut(journal, model, B, b"", [], turn=1, keep=1)
        check_twice(opened, model)
        erase(opened.journal, model, A)
        erase(opened.journal, model, B)
        check_twice(opened, model)


def entries_come_back_as_they_were(bench: Bench) -> None:
    """In order and with their types: each alone, and all together."""
    opened, model = bench.open(), StoreModel()
    for number, entry in enumerate(STRANGE):
        append(opened.journal, model, (f"/app/{number}", entry))
    append(opened.journal, model, *((A, entry) for entry in STRANGE))
    append(opened.journal, model, *((address, entry) for entry in STRANGE[:-1] for address in (B, A)))
    check_twice(opened, model)
    check_twice(opened, model)


def equal_entries_are_kept_each(bench: Bench) -> None:
    """An entry that is equal to one before it is no repetition of it."""
    opened, model = bench.open(), StoreModel()
    for _ in range(3):
        append(opened.journal, model, (A, ("in", 1)), (A, ("in", 1)), (B, ("in", 1)))
    check_twice(opened, model)


def entries_of_another_type_are_refused_or_come_back_with_it(bench: Bench) -> None:
    """A subclass of `str` or `int` never comes back as a plain one."""
    opened = bench.open()
    for entry in SUBCLASSES:
        try:
            opened.journal.append([(A, entry)])
        except TypeError:
            continue
        opened.reopen()
        found = opened.journal.load(A).entries
        if not found or not same(found[-1][1], entry):
            raise PromiseBroken(f"{entry!r} was accepted, and came back as {found[-1:]!r}, of other types")


def what_is_no_entry_is_refused_with_its_whole_batch(bench: Bench) -> None:
    """TypeError, and nothing of the batch is there, wherever in it the wrong one stands."""
    opened, model = bench.open(), StoreModel()
    append(opened.journal, model, (A, ("in", 1)))
    for wrong in NO_ENTRIES:
        for at in range(3):
            batch: list[Any] = [(A, ("in", n)) for n in range(2)]
            batch.insert(at, (B if at == 1 else A, wrong))
            refused(functools.partial(opened.journal.append, batch), f"append of {wrong!r}", TypeError)
        model.check(opened.journal, others=[B])
    append(opened.journal, model, (A, ("in", 2)))
    check_twice(opened, model, others=[B])


def large_batches_are_kept_whole(bench: Bench) -> None:
    """More than a thousand entries at once, and many at once for one address."""
    opened, model = bench.open(), StoreModel()
    append(opened.journal, model, *((f"/app/{n % 3}", ("in", n)) for n in range(MANY_ENTRIES)))
    append(opened.journal, model, *((A, ("in", n)) for n in range(MANY_ENTRIES)))
    check_twice(opened, model)
    gone = list(model.places[A].entries)[:-1]
    cut(opened.journal, model, A, b"x", gone, turn=MANY_ENTRIES, keep=1)
    cut(opened.journal, model, "/app/1", b"x", list(model.places["/app/1"].entries)[::2], turn=2)
    check_twice(opened, model)


def large_values_are_kept(bench: Bench) -> None:
    """Entries, snapshots and notes of megabytes."""
    opened, model = bench.open(), StoreModel()
    data = random.Random(1).randbytes(LARGE)
    append(opened.journal, model, (A, ("in", data, "x" * LARGE)), (A, ("in", 1)))
    note(opened.journal, model, "large", data)
    for address in (A, B):
        cut(opened.journal, model, address, data, [], turn=1)
        cut(opened.journal, model, address, data[::-1], [], turn=2)
    check_twice(opened, model)
    erase(opened.journal, model, A)
    check_twice(opened, model, others=[A])


def thousands_of_addresses_are_kept(bench: Bench) -> None:
    """Each with its entry, of one batch and of batches of their own."""
    opened, model = bench.open(), StoreModel()
    append(opened.journal, model, *((f"/app/{n}", ("in", n)) for n in range(MANY_ADDRESSES)))
    for n in range(0, MANY_ADDRESSES, MANY_ADDRESSES // 8):
        cut(opened.journal, model, f"/app/{n}", b"%d" % n, [], turn=n)
        erase(opened.journal, model, f"/app/{n + 1}")
    opened.reopen()
    addresses = opened.journal.addresses()
    expect(addresses, sorted(model.places), "addresses()")
    for address in addresses[:: max(1, len(addresses) // 40)]:
        expect(tuple(opened.journal.load(address)), tuple(model.places[address].load()), f"load({address!r})")


# ---- snapshots


def a_cut_drops_what_its_address_has_of_drop_and_nothing_else(bench: Bench) -> None:
    """Whatever kind of sequence that is, in any order, with others' positions, and with some that are yet to come."""
    opened, model = bench.open(), StoreModel()
    for turn, form in enumerate(FORMS):
        positions = append(opened.journal, model, *((address, ("in", n)) for n in range(6) for address in (A, B)))
        drop = form(positions[2:8:2])
        cut(opened.journal, model, A, b"%d" % turn, drop, turn=turn + 1, keep=1 + turn % 3)
        model.check(opened.journal)
    cut(opened.journal, model, B, b"none", range(0), turn=1)
    cut(opened.journal, model, B, b"none of these", [10**9, 10**9 + 1], turn=2)
    check_twice(opened, model)
    last = model.last
    cut(opened.journal, model, A, b"what is to come", range(last - 2, last + 50), turn=90)
    append(opened.journal, model, *((address, ("in", n)) for n in range(10) for address in (A, B)))
    check_twice(opened, model)
    cut(opened.journal, model, A, b"next", [], turn=91)
    cut(opened.journal, model, A, b"last", [], turn=92, keep=1)
    check_twice(opened, model)
    cut(opened.journal, model, A, b"all", range(model.last + 1), turn=93, keep=1)
    check_twice(opened, model)


def _as_range(positions: list[int]) -> range:
    return range(positions[0], positions[-1] + 1)


def _as_range_with_a_step(positions: list[int]) -> range:
    """The first of them, the third, and so on."""
    return range(positions[0], positions[-1] + 1, 2 * (positions[1] - positions[0]))


def _as_array(positions: list[int]) -> Sequence[int]:
    return array.array("q", positions)


def _doubled(positions: list[int]) -> list[int]:
    return [*reversed(positions), *positions]


def _with_others(positions: list[int]) -> list[int]:
    return [10**9, 0, *(one + 1 for one in positions), *positions]


FORMS: Final[tuple[Callable[[list[int]], Sequence[int]], ...]] = (
    list,
    tuple,
    _as_range,
    _as_range_with_a_step,
    _as_array,
    _doubled,
    _with_others,
    list,
)
"""What positions to drop may be given as."""


def so_many_snapshots_are_kept_as_were_asked_for(bench: Bench) -> None:
    """With all entries since each of them; `keep` may differ from cut to cut."""
    for keeps in ([1] * 4, [2] * 5, [3] * 5, [5] * 7, [1, 2, 3, 4, 2, 3, 1, 2], [4, 4, 4, 4, 2, 4], [9, 9, 9, 3, 2]):
        opened, model = bench.open(), StoreModel()
        for turn, keep in enumerate(keeps, start=1):
            positions = append(opened.journal, model, *((A, ("in", turn, n)) for n in range(3)), (B, ("in", turn)))
            late = list(model.places[A].entries)[:1] if turn % 2 else []
            cut(opened.journal, model, A, b"%d" % turn, [positions[1], *late], turn=turn, keep=keep)
            model.check(opened.journal)
            if turn == 3:
                opened.reopen()
        check_twice(opened, model)
        older = opened.journal.load(A, older=True)
        expect(tuple(older), tuple(model.places[A].load(1)), "load(older=True)")


def snapshots_and_turns_come_back_as_they_were(bench: Bench) -> None:
    """Of any size, with any turn, and the same bytes twice."""
    opened, model = bench.open(), StoreModel()
    turns = (0, 1, 1, 2**31, 2**32 + 1, 2**53 + 1, 7)
    for turn, size in zip(turns, (0, 1, 1, 1000, 0, (1 << 20) + 1, 5), strict=True):
        cut(opened.journal, model, A, random.Random(size).randbytes(size), [], turn=turn, keep=3)
        cut(opened.journal, model, f"/app/{turn}", b"\0" * size, [], turn=turn, keep=1)
        model.check(opened.journal)
    check_twice(opened, model)


# ---- notes


def notes_are_kept_in_the_order_they_were_written(bench: Bench) -> None:
    """Also those that were written again, and those whose value is empty; what is forgotten is gone."""
    opened, model = bench.open(), StoreModel()
    for key, value in (("child b", b"1"), ("child a", b""), ("other", b"3"), ("child b", b"4"), ("never", None)):
        note(opened.journal, model, key, value)
        model.check(opened.journal, prefixes=["child ", "never"])
    note(opened.journal, model, "other", None)
    note(opened.journal, model, "child a", b"")
    check_twice(opened, model, prefixes=["child ", "child a", "other", "never"])
    note(opened.journal, model, "other", b"\0\xff")
    note(opened.journal, model, "child b", b"4")
    check_twice(opened, model, prefixes=["child ", "o"])


def keys_of_notes_are_not_taken_for_each_other(bench: Bench) -> None:
    """Prefixes, case, NUL, characters that mean something elsewhere, long ones: each key is a prefix, too."""
    opened, model = bench.open(), StoreModel()
    for number, key in enumerate(KEYS):
        note(opened.journal, model, key, b"%d" % number)
    check_twice(opened, model, prefixes=[*KEYS, "child", "c", "zzz", "childx", "/app"])
    for key in KEYS[::2]:
        note(opened.journal, model, key, None)
    check_twice(opened, model, prefixes=KEYS)


def many_notes_are_kept(bench: Bench) -> None:
    """Some hundreds."""
    opened, model = bench.open(), StoreModel()
    for number in range(MANY_NOTES):
        note(opened.journal, model, f"child {number}", b"%d" % number)
    for number in range(0, MANY_NOTES, 17):
        note(opened.journal, model, f"child {number}", b"again")
    check_twice(opened, model)


def notes_stay_through_all_else(bench: Bench) -> None:
    """Entries, cuts, erasures and packs of any address leave them alone, also if a key is an address."""
    opened, model = bench.open(), StoreModel()
    for key in (A, B, f"{A}/note", "child"):
        note(opened.journal, model, key, key.encode())
    fill(opened.journal, model)
    check_twice(opened, model, prefixes=[A])
    erase(opened.journal, model, A)
    forget_blocks(opened.journal, model, B, opened.journal.packs(B))
    check_twice(opened, model, prefixes=[A, B])


# ---- blocks


def blocks_come_back_at_their_places(bench: Bench) -> None:
    """All of a pack or some; of each address, and of each number, its own; compressed or not."""
    blocks = make_blocks(random.Random(1))
    places = [(offset, len(block)) for offset, block in blocks]
    for compress in _compressions():
        opened, model = bench.open(), StoreModel()
        keep_blocks(opened.journal, model, A, 7, blocks, compress)
        keep_blocks(opened.journal, model, B, 7, make_small_blocks(random.Random(2)), compress)
        keep_blocks(opened.journal, model, A, 1 << 55, make_small_blocks(random.Random(3)), compress)
        check_twice(opened, model)
        pack = model.places[A].packs[7]
        for wanted in (places[1:], places[:1], places[::-2], []):
            check_pack(opened.journal, A, 7, {place: pack[place] for place in wanted})


def _compressions() -> list[bool | int]:
    return [False, True, 19] if importlib.util.find_spec("zstandard") else [False]


def blocks_that_are_not_there_are_refused(bench: Bench) -> None:
    """Of another pack, another address, at another place, of another length: DamagedStore."""
    opened, model = bench.open(), StoreModel()
    blocks = make_blocks(random.Random(1))
    keep_blocks(opened.journal, model, A, 7, blocks)
    offset, length = blocks[1][0], len(blocks[1][1])
    for _ in range(2):
        for address, number, place in (
            (A, 8, (offset, length)),
            (B, 7, (offset, length)),
            (f"{A}/b", 7, (offset, length)),
            (A, 7, (offset + PAGE, length)),
            (A, 7, (offset, length + 1)),
            (A, 7, (1 << 40, 1)),
        ):
            what = f"read_blocks({address!r}, {number}, [{place}])"
            refused(functools.partial(opened.journal.read_blocks, address, number, [place]), what, DamagedStore)
        opened.reopen()
    model.check(opened.journal)


def packs_that_are_not_needed_are_forgotten_and_no_others(bench: Bench) -> None:
    """Of this address alone; those of others stay, under the same numbers."""
    opened, model = bench.open(), StoreModel()
    for address in (A, B, f"{A}/b"):
        for number in (1, 2, 3, 1 << 55):
            keep_blocks(opened.journal, model, address, number, make_small_blocks(random.Random(number)))
        cut(opened.journal, model, address, b"of 2", [], turn=1)
    for address, numbers in ((A, [1, 3, 99]), ("/unknown", [1]), (B, ()), (f"{A}/b", {1, 2, 1 << 55})):
        forget_blocks(opened.journal, model, address, numbers)
        model.check(opened.journal)
    check_twice(opened, model)
    forget_blocks(opened.journal, model, A, opened.journal.packs(A))
    check_twice(opened, model)


def many_packs_are_forgotten_at_once(bench: Bench) -> None:
    """All but the newest, as after a snapshot that begins anew."""
    opened, model = bench.open(), StoreModel()
    for number in range(MANY_PACKS):
        keep_blocks(opened.journal, model, A, number, [(0, memoryview(b"%d" % number))])
    cut(opened.journal, model, A, b"of the newest", [], turn=1)
    forget_blocks(opened.journal, model, A, range(MANY_PACKS - 1))
    check_twice(opened, model)


def epochs_rise_over_many_openings(bench: Bench) -> None:
    """Whoever has come to a store has a higher one than all before."""
    opened, model = bench.open(), StoreModel()
    append(opened.journal, model, (A, ("in", 1)))
    for _ in range(MANY_OPENINGS):
        opened.reopen()
    model.check(opened.journal)


# ---- erasing, addresses, and hygiene


def what_is_erased_is_gone_and_nothing_else_is(bench: Bench) -> None:
    """Entries, snapshots and packs; what is written to the address later is all it has then."""
    opened, model = bench.open(), StoreModel()
    fill(opened.journal, model)
    keep_blocks(opened.journal, model, "/app/c", 5, make_small_blocks(random.Random(1)))
    for address in (A, "/unknown", "/app/c"):
        erase(opened.journal, model, address)
        model.check(opened.journal, others=[A, "/unknown"])
    append(opened.journal, model, (A, ("in", 5)))
    check_twice(opened, model)
    cut(opened.journal, model, A, b"new", [], turn=1)
    append(opened.journal, model, (A, ("in", 6)))
    check_twice(opened, model)
    erase(opened.journal, model, A)
    erase(opened.journal, model, A)
    check_twice(opened, model, others=[A])


def addresses_are_not_taken_for_each_other(bench: Bench) -> None:
    """Prefixes, case, NUL, long ones, and characters that mean something in files and databases."""
    opened, model = bench.open(), StoreModel()
    for number, address in enumerate(ADDRESSES):
        first = append(opened.journal, model, (address, ("in", number)), (address, ("in", number, 2)))
        cut(opened.journal, model, address, b"%d" % number, first[:1], turn=number)
        keep_blocks(opened.journal, model, address, 1, make_small_blocks(random.Random(number)))
    check_twice(opened, model)
    for address in ADDRESSES[::2]:
        erase(opened.journal, model, address)
    forget_blocks(opened.journal, model, ADDRESSES[1], [1])
    check_twice(opened, model, others=ADDRESSES)


def nothing_is_shared_with_the_caller(bench: Bench) -> None:
    """What was given may be changed afterwards, and so may what was returned: the store stays as it was."""
    opened, model = bench.open(), StoreModel()
    journal = opened.journal
    batch: list[tuple[str, Entry]] = [(A, ("in", n)) for n in range(4)]
    positions = journal.append(batch)
    model.append(batch, list(positions))
    drop = positions[:2]
    batch.clear()
    positions.clear()
    journal.cut(A, b"x", drop, turn=1)
    model.cut(A, b"x", list(drop), 1, 2)
    drop.clear()
    drop.append(model.last)
    buffer = bytearray(b"block" * 1000)
    keep_blocks(journal, model, A, 1, [(0, memoryview(buffer)[:4096])])
    buffer[:] = bytes(len(buffer))
    note(journal, model, "key", b"value")
    journal.load(A).entries.clear()
    journal.load(A, older=True).entries.append((99, ("in",)))
    journal.notes("").clear()
    journal.addresses().append("/app/z")
    journal.read_blocks(A, 1, [(0, 4096)]).close()
    check_twice(opened, model, others=["/app/z"])
    # A second answer is not the first one, grown.
    answer = opened.journal.load(A)
    before = Saved(answer.snapshot, answer.turn, list(answer.entries))
    append(opened.journal, model, (A, ("in", 9)))
    expect(tuple(answer), tuple(before), "what load returned before an append")


def what_is_closed_refuses_to_write(bench: Bench) -> None:
    """With a StoreError, and a second close does nothing; what was there is there when it is opened again."""
    opened, model = bench.open(), StoreModel()
    fill(opened.journal, model)
    journal = opened.journal
    journal.close()
    journal.close()
    blocks = make_small_blocks(random.Random(1))
    for what, write in (
        ("append", lambda: journal.append([(A, ("in", 1))])),
        ("cut", lambda: journal.cut(A, b"late", [], turn=9)),
        ("note", lambda: journal.note("child a", b"late")),
        ("note of None", lambda: journal.note("child a", None)),
        ("erase", lambda: journal.erase(A)),
        ("keep_blocks", lambda: journal.keep_blocks(A, 9, blocks, False)),
        ("forget_blocks", lambda: journal.forget_blocks(A, [1])),
    ):
        refused(write, f"{what} of a closed store")
    journal.close()
    opened.reopen()
    model.check(opened.journal)


CONTENTS: Final = (
    a_new_store_is_empty,
    positions_rise_over_everything,
    entries_come_back_as_they_were,
    equal_entries_are_kept_each,
    entries_of_another_type_are_refused_or_come_back_with_it,
    what_is_no_entry_is_refused_with_its_whole_batch,
    a_cut_drops_what_its_address_has_of_drop_and_nothing_else,
    so_many_snapshots_are_kept_as_were_asked_for,
    snapshots_and_turns_come_back_as_they_were,
    notes_are_kept_in_the_order_they_were_written,
    notes_stay_through_all_else,
    keys_of_notes_are_not_taken_for_each_other,
    blocks_that_are_not_there_are_refused,
    packs_that_are_not_needed_are_forgotten_and_no_others,
    what_is_erased_is_gone_and_nothing_else_is,
    addresses_are_not_taken_for_each_other,
    nothing_is_shared_with_the_caller,
    what_is_closed_refuses_to_write,
    blocks_come_back_at_their_places,
)
"""What a store holds."""

BOUNDS: Final = (
    large_values_are_kept,
    many_notes_are_kept,
    many_packs_are_forgotten_at_once,
    epochs_rise_over_many_openings,
    thousands_of_addresses_are_kept,
    large_batches_are_kept_whole,
)
"""The same of what is large."""
