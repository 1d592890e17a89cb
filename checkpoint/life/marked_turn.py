"""A turn whose life says on a page, which survives the process, whether it is at work or waits."""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Generator
from types import CodeType
from typing import TYPE_CHECKING, Any, Final

from ..turn_word import WAITS

if TYPE_CHECKING:
    from ..protocol import Feed
    from .recorded_life import Life


class MarkedTurn:
    """What a turn awaits in place of its handler. It has no frame, for that would be kept as long as the turn waits.

    To whoever follows a stack it looks like a generator that awaits the handler.
    """

    __slots__ = ("_feed", "_life", "gi_yieldfrom")

    gi_frame: Final = None

    def __init__(self, life: Life, feed: Feed, handler: Coroutine[Any, Any, Any]) -> None:
        self._life, self._feed, self.gi_yieldfrom = life, feed, handler

    @property
    def gi_code(self) -> CodeType:
        """The code that steps the handler."""
        return MarkedTurn._step.__code__

    def __await__(self) -> Generator[Any, Any, Any]:
        return self  # type: ignore[return-value]  # what `await` needs of one

    def __iter__(self) -> MarkedTurn:
        return self

    def __next__(self) -> Any:
        return self._step(self.gi_yieldfrom.send, None)

    def throw(self, error: BaseException) -> Any:
        """Raise it in the handler, where that waits."""
        return self._step(self.gi_yieldfrom.throw, error)

    def close(self) -> None:
        """Give the handler up."""
        self.gi_yieldfrom.close()

    def _step(self, step: Callable[[Any], Any], value: Any) -> Any:
        self._life.mark(self._feed)
        try:
            awaited = step(value)
        except StopIteration:
            raise
        except BaseException:
            self._life.mark(self._feed, WAITS)  # If it was killed, nobody closes it.
            raise
        self._life.mark(self._feed, WAITS)
        return awaited
