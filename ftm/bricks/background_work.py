"""Background work (`pipe_to_self`) of a protected actor: it runs in the process that leads, and is part of no state."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ...checkpoint.home.switch import Switch
    from ...checkpoint.protocol import Out, PipeDone


class Background:
    """What is out of it, as far as the home knows; `on_lost` is told how much of it will not come back."""

    def __init__(self, switch: Switch, on_lost: Callable[[int], None]) -> None:
        self._switch, self._on_lost = switch, on_lost
        self._out: set[tuple[int, int]] = set()  # by turn and output

    def note(self, turn: int, outs: list[Out]) -> None:
        """A turn has begun some."""
        done = self._switch.ledger.pipes_done.get(turn, ())
        self._out.update((turn, out.k) for out in outs if out.verb == "pipe" and out.k not in done)

    def back(self, record: PipeDone) -> bool:
        """It has an outcome. Does that count? What was said to be lost does not come, nor what has come before.

        More than one run of a turn may have begun it, on one replica or on several, and each is told of. With a replay
        the ledger knows which have come behind the snapshot, and what turns that it contains have begun has its result:
        none is taken while work is out. Without a replay home forgets turns whatever is out.
        """
        one, switch = (record.turn, record.k), self._switch
        is_out = one in self._out
        self._out.discard(one)
        if switch.method.replays:
            is_out = record.turn > switch.ledger.state_turn
        return is_out or not record.k

    def is_lost(self, turn: int | None = None) -> bool:
        """What turns up to this one (None: all) have begun has ended without an outcome.

        Is it begun again if all is replayed? What is not is told of.
        """
        lost = {one for one in self._out if turn is None or one[0] <= turn}
        self._out -= lost
        if lost and not self._switch.method.replays:
            self._on_lost(len(lost))
            return False
        return bool(lost)
