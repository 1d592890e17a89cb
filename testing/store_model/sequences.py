"""Sequences of operations, drawn from a seed, run against an engine and the model, and shrunk when they fail.

Shrinking is delta debugging (Zeller and Hildebrandt, IEEE TSE 2002) over the list of operations.
"""

from __future__ import annotations

import errno
import random
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Final, NamedTuple

from ...actors.errors import StoreError
from ...checkpoint.journal import Entry, Journal
from .bench import Bench, acknowledged
from .comparing import PromiseBroken
from .model import StoreModel
from .samples import make_entry, make_small_blocks
from .watching import FileFault
from .writes import Write, append, cut, do_failing, do_killed, keep_blocks, make_erase, make_forget, note

PLACES: Final = ("/app/a", "/app/b", "/app/a/b", "/app/ab")
KEYS: Final = ("child a", "child b", "child ab", "other")
LENGTH: Final = 40
"""Operations of a sequence."""
SECONDS: Final = 5.0
"""Real seconds that shrinking may take."""
KINDS: Final = {
    "append": 10, "cut": 6, "note": 4, "erase": 2, "keep_blocks": 2, "forget_blocks": 2, "sync": 1, "together": 2,
    "look": 5, "reopen": 2, "kill": 2, "open twice": 1,
}  # fmt: skip
"""How often each kind of operation is drawn."""
WRITES: Final = frozenset(("append", "cut", "note", "erase", "keep_blocks", "forget_blocks"))


class StoreOperation(NamedTuple):
    """One operation; everything else about it follows from the number, and from what the store has."""

    kind: str
    number: int


def draw_operations(seed: int, length: int = LENGTH) -> list[StoreOperation]:
    """The sequence of a seed."""
    draw = random.Random(seed)
    kinds, weights = list(KINDS), list(KINDS.values())
    return [StoreOperation(kind, draw.randrange(1 << 30)) for kind in draw.choices(kinds, weights, k=length)]


class SequenceRun:
    """One run of a sequence.

    Attributes:
        log: what was done, in words.
    """

    def __init__(self, bench: Bench) -> None:
        self.log: list[str] = []
        self._bench = bench
        self._model = StoreModel()
        self._opened = bench.open()

    def do(self, operations: Sequence[StoreOperation]) -> None:
        """Run them all, and compare everything at the end.

        Raises:
            Broken: the engine and the model differ. StoreError: the engine refuses what it must not.
        """
        for operation in (*operations, StoreOperation("look", 0), StoreOperation("reopen", 0)):
            self._do(operation, random.Random(operation.number))

    @property
    def _journal(self) -> Journal:
        return self._opened.journal

    def _do(self, operation: StoreOperation, draw: random.Random) -> None:
        kind = operation.kind
        if kind in WRITES:
            self._write(self._drawn(kind, draw), draw)
            return
        self.log.append(kind)
        if kind == "sync":
            self._journal.sync()
        elif kind == "look":
            self._look()
        elif kind == "reopen" or (kind == "kill" and self._bench.crash is None):
            self._opened.reopen()
            self._look()
        elif kind == "kill":
            self._opened.kill()
            self._look()
        elif kind == "together":
            self._write_together(draw)
        else:
            self._open_twice()

    def _look(self) -> None:
        self._model.check(self._journal, others=PLACES, prefixes=["child ", "child a", "x"])

    def _write(self, write: Write, draw: random.Random) -> None:
        chance = draw.random()
        if chance < 0.15:
            number = draw.randrange(-3, 6)
            self.log.append(f"{write.what}, while {'the disk is full' if number < 0 else f'file call {number} fails'}")
            self._model = do_failing(self._opened, self._model, write, self._fault(number))
        elif chance < 0.3 and self._bench.crash is not None:
            self.log.append(f"{write.what}, killed inside")
            self._model = do_killed(self._opened, self._model, write, draw, 3, draw.choice([1.0, 0.5, 0.3]))
        else:
            self.log.append(write.what)
            write.do(self._journal, self._model)

    def _fault(self, number: int) -> AbstractContextManager[None]:
        return self._bench.fail(self._opened.folder) if number < 0 else FileFault(number, errno.EIO).installed()

    def _drawn(self, kind: str, draw: random.Random) -> Write:
        address = draw.choice(PLACES)
        place = self._model.places.get(address)
        if kind == "append":
            return self._drawn_append(draw, address)
        if kind == "cut":
            return self._drawn_cut(draw, address)
        if kind == "erase":
            return replace(make_erase(address), what=f"erase {address}")
        if kind == "note":
            key, value = draw.choice(KEYS), draw.choice([None, b"", draw.randbytes(20)])
            return Write(f"note {key!r} = {value!r}", kind, "", lambda journal, model: note(journal, model, key, value))
        if kind == "keep_blocks":
            number, blocks = draw.randrange(1 << 55), make_small_blocks(draw)
            return Write(
                f"keep_blocks {address} {number:x}",
                kind,
                address,
                lambda journal, model: keep_blocks(journal, model, address, number, blocks),
            )
        numbers = [number for number in place.packs if draw.random() < 0.5] if place else []
        return replace(make_forget(address, numbers), what=f"forget_blocks {address} {[f'{n:x}' for n in numbers]}")

    def _drawn_append(self, draw: random.Random, address: str) -> Write:
        size = draw.choice([0, 1, 1, 1, 2, 5, 20])
        others = draw.random() < 0.4
        batch: list[tuple[str, Entry]] = [
            (draw.choice(PLACES) if others else address, make_entry(draw)) for _ in range(size)
        ]
        what = f"append {size} to {', '.join(sorted({where for where, _ in batch}))}"
        return Write(what, "append", address, lambda journal, model: append(journal, model, *batch))

    def _drawn_cut(self, draw: random.Random, address: str) -> Write:
        place = self._model.places.get(address)
        known = list(place.entries) if place else []
        drop: list[int] | range = [position for position in known if draw.random() < 0.6]
        if drop and draw.random() < 0.3:
            drop = range(drop[0], drop[-1] + 1)
        size = draw.choice([0, 10, 1000, 1000, 50_000])
        snapshot = draw.randbytes((2 << 20) if draw.random() < 0.02 else size)
        turn, keep = draw.randrange(1000), draw.choice([1, 2, 2, 2, 3, 5])
        what = f"cut {address}, {len(snapshot)} bytes, drop={drop}, turn={turn}, keep={keep}"

        def do(journal: Journal, model: StoreModel) -> None:
            cut(journal, model, address, snapshot, drop, turn=turn, keep=keep)

        return Write(what, "cut", address, do)

    def _write_together(self, draw: random.Random) -> None:
        together: Callable[[], AbstractContextManager[None]] | None = getattr(self._journal, "together", None)
        if together is None:
            return
        with together():
            for kind in draw.choices(["append", "cut", "note"], k=3):
                write = self._drawn(kind, draw)
                self.log.append(f"  {write.what}")
                write.do(self._journal, self._model)

    def _open_twice(self) -> None:
        first = self._journal
        try:
            second = self._bench.factory(self._opened.folder)
        except StoreError:
            return
        if second.epoch <= first.epoch:
            second.close()
            raise PromiseBroken(f"a second opening has epoch {second.epoch} after epoch {first.epoch}")
        self._opened.journal, self._opened.epoch = second, second.epoch
        try:
            acknowledged(first, lambda: first.append([(PLACES[0], ("in", "by the first"))]))
        except StoreError:
            first.close()
            return
        raise PromiseBroken("two openings acknowledge appends at the same time")


def problem_with(bench: Bench, operations: Sequence[StoreOperation]) -> tuple[Exception, list[str]] | None:
    """Run a sequence on a new store; returns what was wrong, and what was done until then."""
    run = SequenceRun(bench)
    try:
        run.do(operations)
    except Exception as error:
        return error, run.log
    finally:
        bench.close()
    return None


def shrink(
    operations: list[StoreOperation], fails: Callable[[list[StoreOperation]], bool], seconds: float = SECONDS
) -> list[StoreOperation]:
    """The shortest sequence found that still fails: halves, quarters and single operations are left out.

    Args:
        operations: a sequence that fails.
        fails: runs another.
        seconds: how long to try, on the real clock.
    """
    end = time.perf_counter() + seconds
    size = max(1, len(operations) // 2)
    while operations:
        at, is_shorter = 0, False
        while at < len(operations) and time.perf_counter() < end:
            shorter = operations[:at] + operations[at + size :]
            if fails(shorter):
                operations, is_shorter = shorter, True
            else:
                at += size
        if time.perf_counter() >= end or (size == 1 and not is_shorter):
            break
        if not is_shorter:
            size = max(1, size // 2)
    return operations


def agrees_with_the_model(bench: Bench, seed: int, *, shrinking: float = SECONDS) -> None:
    """Run the sequence of a seed.

    Args:
        bench: where.
        seed: decides the sequence.
        shrinking: how long to look for a shorter sequence that fails, in seconds.

    Raises:
        Broken: it fails: the text has the seed, what is wrong, and the shortest sequence found.
    """
    operations = draw_operations(seed)
    found = problem_with(bench, operations)
    if found is None:
        return
    if shrinking:
        shortest = shrink(operations, lambda shorter: problem_with(bench, shorter) is not None, shrinking)
        found = problem_with(bench, shortest) or found
    error, log = found
    text = error if isinstance(error, PromiseBroken) else f"{type(error).__name__}: {error}"
    raise PromiseBroken(f"seed {seed}: {text}\nafter:\n  " + "\n  ".join(log)) from error
