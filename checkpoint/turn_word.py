"""The word in shared memory that says which input a recorded life has in hand, and whether it is at work.

A process has one thread for its turns, so that of all turns in hand at most one is at work, and the others wait for
something. If the process dies while one is, it is that one which has ended it, as far as anybody can know. A turn is
not at work while a thread, a task or a process of its own works for it.
"""

from __future__ import annotations

from typing import Final

WAITS: Final = 1 << 63
"""Set while the turn waits for something; the rest is 1 + the number of the input, or 0: none is in hand."""


def input_of(word: int) -> int:
    """The input in hand; -1: none."""
    return (word & ~WAITS) - 1


def is_at_work(word: int) -> bool:
    """Whether there is a turn in hand that does not wait.

    >>> [is_at_work(word) for word in (0, 8, 8 | WAITS)]
    [False, True, False]
    """
    return 0 < word < WAITS


def blamed(word: int, *, one_works: bool) -> int:
    """The input that counts a death of the process; -1: none. `one_works`: some life of that process was at work.

    >>> blamed(8, one_works=True), blamed(8 | WAITS, one_works=True), blamed(8 | WAITS, one_works=False)
    (7, -1, 7)
    """
    return -1 if word >= WAITS and one_works else input_of(word)
