"""The decisions of a supervisor, as pure functions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeVar

from ..actors.exit_reasons import ExitReason
from .rules import Action, Rule

if TYPE_CHECKING:
    from .spec import Restart, Strategy

C = TypeVar("C")


def is_restarted(restart: Restart, reason: ExitReason) -> bool:
    """Whether a child that ended by itself is started again.

    Source:
        Erlang/OTP `supervisor`: permanent always, transient after an abnormal end, temporary never.

    >>> from holdfast.actors.exit_reasons import NORMAL, KILLED
    >>> is_restarted("transient", NORMAL), is_restarted("transient", KILLED), is_restarted("temporary", KILLED)
    (False, True, False)
    """
    return restart == "permanent" or (restart == "transient" and not reason.is_clean)


def decide(restart: Restart, rules: Sequence[Rule], reason: ExitReason) -> Action:
    """What follows from an end: the first rule that fits says it, else the restart type.

    >>> from holdfast.actors.exit_reasons import KILLED
    >>> decide("permanent", (), KILLED), decide("permanent", (Rule("Killed", "stop"),), KILLED)
    ('restart', 'stop')
    """
    for rule in rules:
        if rule.fits(reason):
            return rule.action
    return "restart" if is_restarted(restart, reason) else "stop"


def is_reported(restart: Restart, reason: ExitReason) -> bool:
    """Whether an end is worth a report: every one of a permanent child, abnormal ones of the others (OTP)."""
    return restart == "permanent" or not reason.is_clean


def is_as_told(restart: Restart, told: ExitReason, reason: ExitReason) -> bool:
    """Whether a child that was told to stop ended as it should: a clean end will do for all but permanent ones.

    Source:
        Erlang/OTP `supervisor:do_terminate`.
    """
    return reason == told or (restart != "permanent" and reason.is_clean)


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
