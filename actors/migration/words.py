"""The words of a migration: one kind of frame, both ways, each with the number of its attempt.

The process that the actor leaves or enters and the root tell each other how far they are. What an earlier attempt has
left on its way is void.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

from ..errors import error_text
from ..process.wire import frames
from ..process.wire.connection import Connection
from ..process.wire.frames import BadFrame
from ..values import decode_value, encode_value

if TYPE_CHECKING:
    from ..process.wire.frames import Migrate

PIECE = 4 * 1024 * 1024
"""Bytes per frame of what is told: it may be larger than a frame can be."""
MOST = 2**32
"""Bytes that can be told with one word: more cannot be written as one value either."""
NO_ATTEMPT = 0
"""Instead of a number: the actor lives elsewhere for good, whatever was attempted."""

Heard = Callable[[str, dict[str, Any]], None]
"""Who hears a word: the step, and what is told with it."""


def say(connection: Connection, path: str, attempt: int, step: str, **told: Any) -> None:
    """Say a word about the actor at `path`, with what is told, in pieces.

    Raises:
        UnsavableValue: something of it cannot be sent.
    """
    data = encode_value(told, where=path)
    for at in range(0, len(data), PIECE):
        part, is_last = data[at : at + PIECE], at + PIECE >= len(data)
        connection.send(frames.Migrate(connection.names.to_wire(path), attempt, step, part, is_last), path)


def moment(told: dict[str, Any]) -> float:
    """When it was, as it was told.

    Raises:
        BadFrame: that is no time.
    """
    at = told["at"]
    if not isinstance(at, int | float) or not math.isfinite(at):
        raise BadFrame(f"a moment of a migration that is no time ({at!r})")
    return float(at)


class Incoming:
    """Words that come in pieces, of one attempt; `imports`: from the root, which may have modules imported."""

    def __init__(self, *, imports: bool) -> None:
        self._imports = imports
        self._parts: list[bytes] = []
        self._size = 0

    def take(self, frame: Migrate) -> dict[str, Any] | None:
        """One more piece; all that was told if it was the last.

        Raises:
            BadFrame: it cannot be read, or has no end.
        """
        self._parts.append(frame.part)
        self._size += len(frame.part)
        if self._size > MOST:
            raise BadFrame(f"what is told with {frame.step!r} of a migration has more than {MOST} bytes")
        if not frame.is_last:
            return None
        whole, self._size = b"".join(self._parts), 0
        self._parts.clear()
        try:
            told = decode_value(whole, imports=self._imports)
        except Exception as error:  # Whatever it was made to raise.
            raise BadFrame(f"what is told with {frame.step!r} of a migration: {error_text(error)}") from error
        if not isinstance(told, dict):
            raise BadFrame(f"what is told with {frame.step!r} of a migration is no mapping")
        return cast("dict[str, Any]", told)
