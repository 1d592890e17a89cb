"""The base of the recovery parts: everything they know is in the homes, and outlives them."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from ...actors.kernel.actor import Actor

if TYPE_CHECKING:
    from ..home.homes import Homes


class RecoveryPart(Actor):
    """One of the actors below `/<system>/recovery`.

    It keeps nothing of its own: each life begins by looking at the homes. Nothing waits for it, either: what must be
    done while it is down is done by the homes themselves.
    """

    _is_part: ClassVar[bool] = True

    deterministic = False

    def __init__(self, homes: Homes) -> None:
        self._homes = homes
