"""Promises about kills, failures, other owners and other threads: each function tries one of them on a bench."""

from __future__ import annotations

import errno
import random
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from typing import Any, Final

from ...actors.errors import StoreError
from ...checkpoint.journal import Entry, Journal
from ..threads import NewThreads
from .bench import Bench, OpenEngine, acknowledged
from .comparing import PromiseBroken, refused
from .contents import check_twice
from .model import StoreModel, settle
from .samples import make_small_blocks
from .watching import FileFault, is_renaming, is_sync, is_write, watched
from .writes import A, B, Write, all_writes, append, cut, do_failing, do_killed, erase, fill, note

MOST: Final = 40
"""States of one call that are looked at, at most."""
PATIENCE: Final = 500
"""Looks at a thread that may wait for the very call that waits for it, in a way that nobody sees."""


# ---- kills


def what_was_acknowledged_outlives_a_kill(bench: Bench) -> None:
    """After each kind of write in turn, kill upon kill, all of it is there, and the store can be used on."""
    opened, model = bench.open(), StoreModel()
    fill(opened.journal, model)
    opened.kill()
    model.check(opened.journal)
    for write in all_writes():
        write.do(opened.journal, model)
        opened.kill()
        try:
            model.check(opened.journal)
        except (PromiseBroken, StoreError) as error:
            raise PromiseBroken(f"after {write.what} and a kill: {error}") from error
    opened.kill()
    fill(opened.journal, model)
    check_twice(opened, model)


def a_kill_leaves_all_writes_up_to_some_one(bench: Bench) -> None:
    """Where only a sync makes safe, what was not synced may be gone, but only from some write on, and whole writes."""
    for count in range(1, len(all_writes()) + 1):
        opened, model = bench.open(), StoreModel()
        fill(opened.journal, model)
        opened.kill()
        states = [model.copy()]
        for write in all_writes()[:count]:
            write.do(opened.journal, model)
            if write.kind == "sync" or opened.safe_at == "append":
                states.clear()
            states.append(model.copy())
        opened.kill(synced=False)
        model = settle(opened.journal, states[::-1])
        append(opened.journal, model, (A, ("in", "later")))
        check_twice(opened, model)
        bench.close()


def a_kill_before_the_first_write_is_survived(bench: Bench) -> None:
    """The epoch rises over kills, too, and positions do, when nothing else was written."""
    opened, model = bench.open(), StoreModel()
    for _ in range(3):
        opened.kill()
        model.check(opened.journal)
    append(opened.journal, model, (A, ("in", 1)))
    erase(opened.journal, model, A)
    opened.kill()
    append(opened.journal, model, (A, ("in", 1)))
    opened.kill()
    cut(opened.journal, model, A, b"", list(model.places[A].entries), turn=1, keep=1)
    opened.kill()
    append(opened.journal, model, (A, ("in", 2)))
    check_twice(opened, model)


def a_kill_inside_a_write_leaves_all_of_it_or_nothing(bench: Bench) -> None:
    """At each change of the files within each kind of write, with the newest write to a file whole and torn."""
    opened, model = bench.open(), StoreModel()
    fill(opened.journal, model)
    draw = random.Random(5)
    for write in all_writes():
        model = do_killed(opened, model, write, draw, MOST)
    model.check(opened.journal)


def a_kill_inside_an_opening_or_a_closing_is_survived(bench: Bench) -> None:
    """At each change of the files: everything that was acknowledged is there, and the epoch rises."""
    opened, model = bench.open(), StoreModel()
    fill(opened.journal, model)
    draw = random.Random(6)
    opened.kill()
    for _ in range(2):
        append(opened.journal, model, (A, ("in", "more")))
        with opened.killing(draw, MOST) as copies:
            opened.reopen()
        for number, folder in enumerate(copies):
            try:
                again = bench.open(folder)
                model.check(again.journal)
                again.reopen()
                model.check(again.journal)
            except Exception as error:  # An opening may raise anything.
                raise PromiseBroken(f"a kill inside a reopening, at change {number} of the files: {error}") from error
            again.journal.close()


# ---- failures


def _failing(bench: Bench, opened: OpenEngine, number: int) -> AbstractContextManager[None]:
    return bench.fail(opened.folder) if number < 0 else FileFault(number, errno.ENOSPC).installed()


def a_write_that_fails_leaves_everything_as_it_was(bench: Bench) -> None:
    """It raises a StoreError, on a full disk as at each single file operation, and half of it is nowhere.

    Afterwards the store goes on, or refuses everything until it is opened again.
    """
    for number in (-1, *range(12)):
        opened, model = bench.open(), StoreModel()
        fill(opened.journal, model)
        for write in all_writes():
            if write.kind == "sync":
                continue
            fault = _failing(bench, opened, number)
            try:
                model = do_failing(opened, model, write, fault)
            except (PromiseBroken, StoreError) as error:
                disk = "on a full disk" if number < 0 else f"when file operation {number} of it fails"
                raise PromiseBroken(f"{write.what} {disk}: {error}") from error
        opened.journal.close()


def after_a_failed_sync_everything_is_refused(bench: Bench) -> None:
    """Until the store is opened again: nobody knows what the disk has."""
    opened, model = bench.open(), StoreModel()
    append(opened.journal, model, (A, ("in", 1)))
    fault = FileFault(0, which=is_sync)
    problem: Exception | None = None
    try:
        with fault.installed():
            opened.journal.sync()
    except Exception as error:
        problem = error
    if not fault.struck:
        return  # Its syncs are not made by Python code.
    if not isinstance(problem, StoreError):
        raise PromiseBroken(f"sync raised {problem!r} when {fault.struck} had failed, which is no StoreError")
    blocks = make_small_blocks(random.Random(1))
    for what, write in (
        ("append", lambda: opened.journal.append([(A, ("in", 2))])),
        ("sync", lambda: opened.journal.sync()),
        ("cut", lambda: opened.journal.cut(A, b"x", [], turn=1)),
        ("note", lambda: opened.journal.note("key", b"x")),
        ("keep_blocks", lambda: opened.journal.keep_blocks(A, 1, blocks, False)),
    ):
        refused(write, f"{what} after a failed sync")
    opened.reopen()
    check_twice(opened, model)


def what_was_written_is_synced(bench: Bench) -> None:
    """Where Python code writes the files, it syncs one of them before `sync` returns, and one after it gave a name."""
    opened = bench.open()
    seen: list[str] = []

    def look(event: str, call: Any) -> None:
        if event == "c_return" and (is_write(call) or is_sync(call) or is_renaming(call)):
            seen.append("sync" if is_sync(call) else "name" if is_renaming(call) else "write")

    for number in range(3):
        seen.clear()
        with watched(look):
            opened.journal.append([(A, ("in", number))])
            opened.journal.sync()
        if "write" in seen and "sync" not in seen:
            raise PromiseBroken(
                "append wrote to a file, and sync returned without fsync or fdatasync: nothing is synced"
            )
        if "name" in seen and "sync" not in seen[-seen[::-1].index("name") - 1 :]:
            raise PromiseBroken(
                "a file was given its name, and sync returned with nothing synced since: a power failure takes the name"
            )


# ---- owners and threads


def of_two_openings_one_acknowledges(bench: Bench) -> None:
    """The second is refused, or the first is: never do both go on, nor is anything lost that was acknowledged."""
    opened, model = bench.open(), StoreModel()
    fill(opened.journal, model)
    first = opened.journal
    first.sync()  # What is not may be gone with its owner.
    try:
        second = bench.factory(opened.folder)
    except StoreError:
        model.check(first)
        append(first, model, (A, ("in", "first")))
        check_twice(opened, model)
        refused(lambda: bench.factory(opened.folder), "a second opening, after the first was closed and opened again")
        return
    try:
        blocks = make_small_blocks(random.Random(1))
        if second.epoch <= first.epoch:
            raise PromiseBroken(f"the second opening has epoch {second.epoch} after epoch {first.epoch}")
        acknowledged(second, lambda: append(second, model, (A, ("in", "second"))))
        for what, write in (
            ("append", lambda: first.append([(A, ("in", "first"))])),
            ("cut", lambda: first.cut(A, b"first", [], turn=99)),
            ("note", lambda: first.note("child a", b"first")),
            ("erase", lambda: first.erase(A)),
            ("keep_blocks", lambda: first.keep_blocks(A, 99, blocks, False)),
        ):
            refused(partial(acknowledged, first, write), f"{what} by the first of two openings")
        first.close()
        append(second, model, (A, ("in", "second, when the first was closed")))
        model.check(second)
    finally:
        second.close()
    opened.journal = bench.factory(opened.folder)
    model.check(opened.journal)


def appends_go_on_in_other_threads(bench: Bench) -> None:
    """An append at each moment of a cut, a load and an erase of other addresses, in a thread of its own."""
    opened, model = bench.open(), StoreModel()
    fill(opened.journal, model)
    writes = [write for write in all_writes() if write.what in ("cut", "note", "keep_blocks", "sync", "erase")]
    for write in (*writes, Write("load", "load", A, lambda journal, _: journal.load(A))):
        for moment in range(0, 60, 7):
            if A not in model.places:
                append(opened.journal, model, *((A, ("in", n)) for n in range(3)))
            guest = _Guest(opened.journal, moment)
            after = model.copy()
            with watched(guest.look):
                write.do(opened.journal, after)
            model = after
            guest.finish(model, write.what)
            model.check(opened.journal)
    check_twice(opened, model)


class _Guest:
    """A thread that appends once, at a moment of another call, which waits until it is through or waits itself."""

    def __init__(self, journal: Journal, moment: int) -> None:
        self._left = moment
        self._entry: tuple[str, Entry] = ("/app/guest", ("in", moment))
        self._positions: list[int] = []
        self._problem: Exception | None = None
        self._journal = journal
        self._thread = threading.Thread(target=self._append, name="guest")
        self._has_begun = False

    def _append(self) -> None:
        try:
            self._positions = self._journal.append([self._entry])
        except Exception as error:
            self._problem = error

    def look(self, event: str, _: Any) -> None:
        """At the right moment, begin."""
        self._left -= 1
        if self._left >= 0 or self._has_begun:
            return
        self._has_begun = True
        threads = NewThreads()
        self._thread.start()
        for _ in range(PATIENCE):
            self._thread.join(0.001)
            if not self._thread.is_alive() or not threads.at_work():
                break

    def finish(self, model: StoreModel, what: str) -> None:
        """Wait for it, and have the model know of it."""
        if not self._has_begun:
            return
        self._thread.join()
        if self._problem is not None:
            problem = f"{type(self._problem).__name__}: {self._problem}"
            raise PromiseBroken(f"an append in another thread while {what} ran raised {problem}") from self._problem
        if type(self._positions) is not list or len(self._positions) != 1:
            raise PromiseBroken(f"an append in another thread while {what} ran returned {self._positions!r}")
        (position,) = self._positions
        if any(position in place.entries for place in model.places.values()):
            raise PromiseBroken(
                f"an append in another thread while {what} ran has position {position}, which is another's"
            )
        model.last = max(model.last, position)
        model.place(self._entry[0]).entries[position] = self._entry[1]


# ---- several writes as one


def what_is_written_together_is_kept_together(bench: Bench) -> None:
    """For engines that have `together`: a kill inside leaves all of it or nothing."""
    opened, model = bench.open(), StoreModel()
    together: Callable[[], AbstractContextManager[None]] | None = getattr(opened.journal, "together", None)
    if together is None:
        return
    fill(opened.journal, model)
    for _ in range(2):
        before = model.copy()
        with opened.killing(random.Random(7), MOST) as copies, together():
            note(opened.journal, model, "child b", b"together")
            append(opened.journal, model, (A, ("in", "together")), (B, ("in", "together")))
            note(opened.journal, model, "child a", None)
            cut(opened.journal, model, A, b"together", list(model.places[A].entries)[:1], turn=50)
        for number, folder in enumerate(copies if bench.crash else []):
            broken = [before, model, *model.after_broken_cut(before, A)]
            try:
                with opened.surviving(folder) as journal:
                    settle(journal, broken)
            except (PromiseBroken, StoreError) as error:
                raise PromiseBroken(f"a kill within together(), at change {number} of the files: {error}") from error
    check_twice(opened, model)


KILLS: Final = (
    a_kill_before_the_first_write_is_survived,
    what_was_acknowledged_outlives_a_kill,
    a_kill_leaves_all_writes_up_to_some_one,
    a_kill_inside_a_write_leaves_all_of_it_or_nothing,
    a_kill_inside_an_opening_or_a_closing_is_survived,
    what_is_written_together_is_kept_together,
)
"""What needs a crash hook."""

ACCIDENTS: Final = (
    of_two_openings_one_acknowledges,
    what_was_written_is_synced,
    after_a_failed_sync_everything_is_refused,
    a_write_that_fails_leaves_everything_as_it_was,
    appends_go_on_in_other_threads,
)
"""What needs none."""
