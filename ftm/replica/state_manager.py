"""The state manager of a replica: captures and rewinds the actor's state, and takes over another's."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Final

import msgspec

from ...actors.errors import DamagedValue
from ...actors.kernel.actor import Actor, on
from ...actors.kernel.bindings import Binding
from ...actors.kernel.message import Message
from ..bricks.brick_messages import ServerState, StateDelta
from ..bricks.state_images import Misfit
from .rewind_points import change_since, led_to

if TYPE_CHECKING:
    from ..bricks.standing import Standing

MISFIT: Final = -3
"""In place of a turn: these differences do not fit; all of it is wanted."""


class Captured(msgspec.Struct):
    """A state, and what leads to it from an earlier one, if that is known and less."""

    state: ServerState
    change: StateDelta | None


class Capture(Message[Captured]):
    """The state after the last turn, and what has changed since turn `since`."""

    since: int = -2


class Apply(Message[int]):
    """Keep this state instead of one's own, whole or not at all; a life is made of it when one is wanted (T8b).

    The reply is its turn; `MISFIT` if these are differences to something else, or damaged: then nothing has changed.
    """

    state: ServerState | StateDelta


class StateManager(Actor):
    """Between the bricks and the protected actor's state. It is asked between two parts, never while one runs."""

    _is_part: ClassVar[bool] = True

    server: Binding[Actor]

    def __init__(self, standing: Standing) -> None:
        self._standing = standing

    @on(Capture)
    def capture(self, message: Capture) -> Captured:
        """Save the state, and work out what has changed in it."""
        server = self._standing.server
        state = server.capture()
        change = change_since(server.points, message.since)
        server.points.given = state  # Whoever asked has all of it from now on.
        return Captured(state, change)

    @on(Apply)
    async def apply(self, message: Apply) -> int:
        """Have the state that the other replica has said."""
        server = self._standing.server
        try:
            state = led_to(server.points.point, message.state)
        except (Misfit, DamagedValue):
            return MISFIT
        had_life = server.life is not None
        if had_life:
            await server.drop_life()
        server.install(state)
        if had_life:
            await server.ensure()
        return server.turn
