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


def digest_of(actor: Actor) -> int:
    """A number for the actor's state: equal states have equal ones, whichever process they are in; never 0.

    Raises:
        UnsavableValue, StateMismatch: the state cannot be saved.
    """
    return int.from_bytes(state_digest(decode_value(save_state(actor), refs=actor.ctx._cell.node.ref_at))[:7]) | 1
