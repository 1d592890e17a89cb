"""A thread that lets the event loop's thread have its turn.

Python takes the interpreter from a thread that computes only after five milliseconds, and again at each of the loop's
wake-ups. A diagnosis of a large system computes for tens of them. So where it runs beside a loop, it pauses for a
moment after each bit of work: whoever waits goes first.
"""

from __future__ import annotations

import contextlib
import contextvars
import time
from collections.abc import Generator, Iterable, Iterator
from typing import Final, TypeVar

T = TypeVar("T")

_PAUSE: Final = 5e-5  # seconds; 0 would not do: a thread that asks for the interpreter again at once may well get it
_IS_BESIDE: contextvars.ContextVar[bool] = contextvars.ContextVar("is_beside", default=False)


@contextlib.contextmanager
def beside_a_loop() -> Generator[None]:
    """What runs within this pauses; elsewhere `breathe` does nothing."""
    token = _IS_BESIDE.set(True)
    try:
        yield
    finally:
        _IS_BESIDE.reset(token)


def breathe() -> None:
    """Pause for a moment, so that the event loop's thread has its turn."""
    if _IS_BESIDE.get():
        time.sleep(_PAUSE)


def breathing(items: Iterable[T], every: int = 256) -> Iterable[T]:
    """The items, with a pause after every so many."""
    return _breathing(items, every) if _IS_BESIDE.get() else items


def _breathing(items: Iterable[T], every: int) -> Iterator[T]:
    for number, item in enumerate(items, 1):
        yield item
        if number % every == 0:
            time.sleep(_PAUSE)
