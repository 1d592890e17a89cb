"""Writes into an engine and its model alike, and what each may leave behind when it is interrupted."""

from __future__ import annotations

import random
from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

from ...actors.errors import StoreError
from ...checkpoint.journal import Entry, Journal
from .bench import OpenEngine
from .comparing import PromiseBroken
from .model import StoreModel, settle
from .samples import make_small_blocks

A, B = "/app/a", "/app/b"


def append(journal: Journal, model: StoreModel, *entries: tuple[str, Entry]) -> list[int]:
    """Append to both."""
    positions = journal.append(list(entries))
    model.append(entries, positions)
    return positions


def cut(
    journal: Journal,
    model: StoreModel,
    address: str,
    snapshot: bytes,
    drop: Sequence[int] | range,
    *,
    turn: int,
    keep: int = 2,
) -> None:
    """Cut both."""
    journal.cut(address, snapshot, drop, turn=turn, keep=keep)
    model.cut(address, snapshot, drop, turn, keep)


def note(journal: Journal, model: StoreModel, key: str, value: bytes | None) -> None:
    """Write a note to both."""
    journal.note(key, value)
    model.note(key, value)


def keep_blocks(
    journal: Journal,
    model: StoreModel,
    address: str,
    number: int,
    blocks: Sequence[tuple[int, memoryview]],
    compress: bool | int = False,
) -> None:
    """Keep a pack in both."""
    pack = {(offset, len(block)): bytes(block) for offset, block in blocks}
    journal.keep_blocks(address, number, blocks, compress)
    model.keep_blocks(address, number, pack)


def erase(journal: Journal, model: StoreModel, address: str) -> None:
    """Erase an address of both."""
    journal.erase(address)
    model.erase(address)


def forget_blocks(journal: Journal, model: StoreModel, address: str, numbers: Collection[int]) -> None:
    """Forget packs in both."""
    journal.forget_blocks(address, numbers)
    model.forget_blocks(address, numbers)


def fill(journal: Journal, model: StoreModel) -> None:
    """Put something of every kind into both."""
    draw = random.Random(1)
    for address in (A, B):
        first = append(journal, model, (address, ("in", 1)), (address, ("in", 2)), (address, ("in", 3)))
        keep_blocks(journal, model, address, 1, make_small_blocks(draw))
        cut(journal, model, address, b"older", first[:1], turn=1)
        append(journal, model, (A, ("in", 4)), (B, ("in", 5)), (A, ("out", 6)))
        keep_blocks(journal, model, address, 2, make_small_blocks(draw))
        cut(journal, model, address, b"newer", first[1:2], turn=2)
        append(journal, model, (address, ("in", 7)))
    for key in ("child b", "child a", "other", "child c"):
        note(journal, model, key, key.encode())
    note(journal, model, "child b", b"again")
    note(journal, model, "child c", None)


@dataclass(frozen=True)
class Write:
    """One write.

    Attributes:
        what: in words.
        kind: the method of the journal.
        address: whose it is, where it is of one.
        do: writes into an engine and then into a model.
        remove: for what only removes: what it does to a model.
    """

    what: str
    kind: str
    address: str
    do: Callable[[Journal, StoreModel], object]
    remove: Callable[[StoreModel], None] | None = None

    def left(self, before: StoreModel, after: StoreModel) -> list[StoreModel]:
        """The states that may be there when it was broken off by a kill.

        A cut keeps its snapshot first and removes older ones later; packs are removed one by one.
        """
        if self.kind == "cut":
            return [before, after, *after.after_broken_cut(before, self.address)]
        if self.kind == "erase":
            return [before, after.unsettle(before)]
        return [after.unsettle(before)] if self.kind == "forget_blocks" else [before, after]

    def after_error(self, before: StoreModel) -> list[StoreModel]:
        """The states that may be there when it has raised: as it was, but what only removes may have removed."""
        if self.remove is None:
            return [before]
        after = before.copy()
        self.remove(after)
        return self.left(before, after)

    def after_success(self, before: StoreModel, after: StoreModel) -> list[StoreModel]:
        """The states that may be there when it has not raised, though the disk failed."""
        return self.left(before, after)[1:] if self.kind == "cut" else [after]


def do_failing(opened: OpenEngine, model: StoreModel, write: Write, fault: AbstractContextManager[None]) -> StoreModel:
    """Write while the disk fails, and open the store again; returns what it has then.

    Raises:
        Broken: half of it is there, or it raised something else than a StoreError.
    """
    after = model.copy()
    try:
        with fault:
            write.do(opened.journal, after)
    except StoreError:
        allowed = write.after_error(model)
    except PromiseBroken:
        raise
    except Exception as error:
        problem = f"{type(error).__name__} ({error})"
        raise PromiseBroken(f"{write.what} raised {problem} for a failing disk, which is no StoreError") from error
    else:
        allowed = write.after_success(model, after)
    try:
        settle(opened.journal, allowed)
    except PromiseBroken:
        if not _refuses_everything(opened.journal):
            raise
    opened.reopen()
    return settle(opened.journal, allowed)


def _refuses_everything(journal: Journal) -> bool:
    try:
        journal.append([("/app/z", ("in", 1))])
    except StoreError:
        return True
    return False


def do_killed(
    opened: OpenEngine, model: StoreModel, write: Write, draw: random.Random, most: int, share: float = 1.0
) -> StoreModel:
    """Write, and look at what kills meanwhile would have left; returns what the store has then.

    Args:
        opened: the store.
        model: what it has before.
        write: what to write.
        draw: see `OpenEngine.killing`, with `most` and `share`.

    Raises:
        Broken: a kill leaves half of it, or something else than before.
    """
    after = model.copy()
    with opened.killing(draw, most, share) as copies:
        write.do(opened.journal, after)
    for number, folder in enumerate(copies):
        try:
            with opened.surviving(folder) as journal:
                left = settle(journal, write.left(model, after))
                append(journal, left, (A, ("in", "later")), (B, ("in", "later")))
                left.check(journal)
        except Exception as error:  # An opening may raise anything.
            raise PromiseBroken(f"a kill inside {write.what}, at change {number} of the files: {error}") from error
    return after


def all_writes() -> list[Write]:
    """Each kind of write, for what `fill` has written."""
    blocks = make_small_blocks(random.Random(3))
    batch: list[tuple[str, Entry]] = [(f"/app/{n}", ("in", n, "x" * 300)) for n in (0, 1, 0, 2, 1)]

    def shorten(journal: Journal, model: StoreModel) -> None:
        cut(journal, model, A, b"cut", list(model.places[A].entries)[:2], turn=3)

    def cut_off(journal: Journal, model: StoreModel) -> None:
        cut(journal, model, A, b"one" * 4000, list(model.places[A].entries)[:-1], turn=4, keep=1)

    def cut_large(journal: Journal, model: StoreModel) -> None:
        cut(journal, model, B, b"large" * 300_000, list(model.places[B].entries)[1:], turn=5)

    mixed = [*batch, (A, ("in", 9)), (B, ("in", 9))]
    return [
        Write("append", "append", A, lambda journal, model: append(journal, model, (A, ("in", 8)))),
        Write("append of a batch", "append", A, lambda journal, model: append(journal, model, *mixed)),
        Write("append of a large batch", "append", A, lambda journal, model: append(journal, model, *batch * 60)),
        Write("cut", "cut", A, shorten),
        Write("cut with keep=1", "cut", A, cut_off),
        Write("cut of a large snapshot", "cut", B, cut_large),
        Write("note", "note", "", lambda journal, model: note(journal, model, "child b", b"newer")),
        Write("note of None", "note", "", lambda journal, model: note(journal, model, "child a", None)),
        Write("keep_blocks", "keep_blocks", A, lambda journal, model: keep_blocks(journal, model, A, 9, blocks)),
        make_forget(A, [1]),
        Write("sync", "sync", "", lambda journal, model: journal.sync()),
        make_erase(A),
    ]


def make_erase(address: str) -> Write:
    """An erasure."""

    def do(journal: Journal, model: StoreModel) -> None:
        erase(journal, model, address)

    return Write("erase", "erase", address, do, lambda model: model.erase(address))


def make_forget(address: str, numbers: Collection[int]) -> Write:
    """A removal of packs."""

    def do(journal: Journal, model: StoreModel) -> None:
        forget_blocks(journal, model, address, numbers)

    return Write("forget_blocks", "forget_blocks", address, do, lambda model: model.forget_blocks(address, numbers))
