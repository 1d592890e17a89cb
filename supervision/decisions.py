"""What a supervisor decides, as pure functions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeVar

from ..actors.exits import ExitReason

if TYPE_CHECKING:
    from .spec import Restart, Strategy

C = TypeVar("C")


def is_restarted(restart: Restart, reason: ExitReason) -> bool:
    """Whether a child that ended by itself is started again.

    Source:
        Erlang/OTP `supervisor`: permanent always, transient after an abnormal end, temporary never.

    >>> from holdfast.actors.exits import NORMAL, KILLED
    >>> is_restarted("transient", NORMAL), is_restarted("transient", KILLED), is_restarted("temporary", KILLED)
    (False, True, False)
    """
    return restart == "permanent" or (restart == "transient" and not reason.is_clean)


def affected(strategy: Strategy, order: Sequence[C], failed: int) -> list[C]:
    """The children that are started again when the one at index `failed` needs it, in start order.

    >>> affected("rest_for_one", ["a", "b", "c"], 1)
    ['b', 'c']
    """
    match strategy:
        case "one_for_one":
            return [order[failed]]
        case "one_for_all":
            return list(order)
        case "rest_for_one":
            return list(order[failed:])
