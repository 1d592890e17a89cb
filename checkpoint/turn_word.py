"""The word in shared memory that says which input a recorded life has in hand, and whether it is at work.

A process has one thread for its turns, so that of all turns in hand at most one is at work, and the others wait for
something. If the process dies while one is, it is that one which has ended it, as far as anybody can know. A turn is
at work while its async effects are stepped, too; not while a thread, a task or a process of its own works for it.
"""

from __future__ import annotations

from typing import Final

from ..actors.exit_reasons import ExitReason, OutOfMemory

WAITS: Final = 1 << 63
"""Set while the turn waits for something; below the flags stands 1 + the number of the input, or 0: there was none."""
OVER: Final = 1 << 62
"""Set when that turn counts for nothing that ends the process: it is over, or rests for days."""
BACK: Final = 1 << 61
"""Set once an input has begun behind a later one: then the number says nothing about the others."""
IDLE: Final = 1 << 60
"""Set beside `WAITS` if the process does nothing unseen for the turn: no thread works for it, nor a task of its own."""


class TurnWord:
    """The word, for the life that writes it."""

    __slots__ = ("_back", "_number", "_top", "_words")

    def __init__(self, words: memoryview) -> None:
        self._words = words
        self._back = self._number = self._top = 0

    def clear(self) -> None:
        """A life begins: what stood there is the turn in which an earlier one was killed."""
        self._words[0] = 0

    def begin(self, key: int) -> None:
        """The turn of this input begins."""
        number = self._number = key + 1
        if number < self._top:
            self._back = BACK
        self._top = number
        self._words[0] = number | self._back

    def mark(self, how: int) -> None:
        """The last turn that has begun is at work (0), waits, or is over."""
        self._words[0] = self._number | self._back | how

    def look(self, key: int) -> None:
        """This input is looked at beside the turn in hand, until `mark`."""
        self._words[0] = key + 1 | BACK

    @property
    def how(self) -> int:
        """How the last turn stands."""
        return int(self._words[0]) & (WAITS | OVER | IDLE)


def input_of(word: int) -> int:
    """The input in hand; -1: none.

    >>> [input_of(word) for word in (0, 8, 8 | WAITS, 8 | WAITS | IDLE, 8 | BACK, 8 | OVER)]
    [-1, 7, 7, 7, 7, -1]
    """
    return -1 if word & OVER else (word & (IDLE - 1)) - 1


def may_have_begun(word: int, key: int) -> bool:
    """Whether the turn of an input may have begun in this life, which begins them in order as long as it can.

    >>> [may_have_begun(word, 7) for word in (0, 7, 8, 8 | OVER, 9 | OVER, 7 | OVER, 7 | BACK)]
    [False, False, True, True, True, False, True]
    """
    return bool(word & BACK) or key < word & (IDLE - 1)


def is_at_work(word: int) -> bool:
    """Whether there is a turn in hand that does not wait.

    >>> [is_at_work(word) for word in (0, 8, 8 | WAITS, 8 | OVER)]
    [False, True, False, False]
    """
    return 0 < word < OVER


def blamed(word: int, *, one_works: bool) -> int:
    """The input that counts a death of the process; -1: none. `one_works`: some life of that process was at work.

    >>> blamed(8, one_works=True), blamed(8 | WAITS, one_works=True), blamed(8 | WAITS, one_works=False)
    (7, -1, 7)
    >>> blamed(8 | WAITS | IDLE, one_works=False)
    -1
    """
    return -1 if word & WAITS and (one_works or word & IDLE) else input_of(word)


def is_innocent(word: int, reason: ExitReason, *, one_works: bool) -> bool:
    """Whether the end of the process counts for nothing against the turn; its memory belongs to all turns in hand."""
    if isinstance(reason, OutOfMemory):
        return False
    return reason.blames_nobody or blamed(word, one_works=one_works) < 0
