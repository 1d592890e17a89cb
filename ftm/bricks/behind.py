"""Words of a replica other than turn ends, held back until the home has the turns they follow.

Another leader is asked again for the ends that home does not have, one batch after the other; what it has to say
besides is ready at once, and may even be about turns that home has never heard of.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator

from ...checkpoint.protocol import Closed, PipeDone
from .brick_messages import Beside, Strayed


class Behind:
    """What waits for turns, in the order in which it came."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[int, Beside]] = deque()

    def put(self, turn: int, records: Iterable[Beside]) -> None:
        """These stand behind this turn."""
        for record in records:
            if isinstance(record, Strayed):  # It is about no turn: from now on that replica does not count.
                self._waiting.appendleft((-1, record))
            else:
                self._waiting.append((turn, record))

    def due(self, turn: int | None) -> Iterator[Beside]:
        """Those that stand behind turns up to this one (None: any) wait no longer."""
        while self._waiting and (turn is None or self._waiting[0][0] <= turn):
            yield self._waiting.popleft()[1]

    def drop(self) -> None:
        """Whoever has said it has died, and so have the turns that it stands behind."""
        self._waiting.clear()


def is_still_due(record: Beside, turn: int) -> bool:
    """Whether a follower that is to lead has to say this to a home that has all turns up to this one.

    What was begun before was begun by the leader too, as far as home knows, and has ended with that.
    """
    return isinstance(record, Closed) or (isinstance(record, PipeDone) and record.turn > turn)
