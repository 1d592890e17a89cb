"""The replay check: the state after each turn has a digest, and a replay that leads elsewhere is stopped (T21)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...actors.errors import ReplayDiverged
from ...actors.values import decode_value, state_digest
from ..snapshot.key_variables import save_state

if TYPE_CHECKING:
    from ...actors.kernel.actor import Actor


class StateDiverged(ReplayDiverged):
    """A replayed turn has left another state than before the crash; it is the first one that has."""

    def __init__(self, actor: str, turn: int, message: str) -> None:
        super().__init__(actor, turn, 0)
        self.args = (actor, turn, message)
        self.message = message

    def __str__(self) -> str:
        return (
            f"replay of {self.actor} diverged at turn {self.turn}: after {self.message} its state is not what it was "
            "before the crash; use ctx.now(), ctx.random and ctx.uuid(), and find the cause with hybrid(strict=True)"
        )


def digest_of(actor: Actor) -> int:
    """A number for the actor's state: equal states have equal ones, whichever process they are in; never 0.

    Raises:
        UnsavableValue, StateMismatch: the state cannot be saved.
    """
    return int.from_bytes(state_digest(decode_value(save_state(actor)))[:7]) | 1
