"""The overflow policy of a full mailbox: one rule for every mailbox, wherever it is kept."""

from __future__ import annotations

from typing import Any, Final, Literal, get_args

from .errors import SpecError

Overflow = Literal["block", "reject", "drop_newest", "drop_oldest", "latest"]
"""Who gives way: the sender waits, the sender is told, the new message, the oldest that waits, all that wait."""
Verdict = Literal["take", "wait", "refuse", "lose"]
"""The message is admitted; it waits for room; its sender is told that there is none; it is a dead letter."""

FULL: Final = "mailbox full ("
FULL_WHILE_HELD: Final = "there was no room while messages were held (for "
DROPS: Final = frozenset(("drop_oldest", "latest"))
"""Policies that take back what was admitted: it must not be handed on before its turn."""


def decide(overflow: Overflow, capacity: int, *, is_ask: bool) -> tuple[Verdict, int]:
    """What is done with one more message at a full mailbox, and how many of those that wait are kept for it."""
    match overflow:
        case "block":
            return "wait" if is_ask else "refuse", capacity
        case "reject":
            return "refuse", capacity
        case "drop_newest":
            return "lose", capacity
        case "drop_oldest":
            return "take", capacity - 1
        case "latest":
            return "take", 0


def drop_reason(capacity: int, overflow: str) -> str:
    """Why a message is a dead letter that a full mailbox does not keep by its policy."""
    return f"{FULL}{capacity}, {overflow})"


def held_drop_reason(capacity: int, overflow: str) -> str:
    """Why a message is a dead letter that is not held during a recovery, by the policy of `held=`."""
    return f"{FULL_WHILE_HELD}{capacity}, {overflow})"


def is_of_policy(why: str) -> bool:
    """Whether a dead letter is one by the overflow policy that somebody has chosen, as its `why` says."""
    return why.startswith((FULL, FULL_WHILE_HELD))


def check(where: str, capacity: Any, overflow: Any) -> None:
    """Raises SpecError: what a mailbox was given is no capacity, or no policy."""
    if not isinstance(capacity, int) or isinstance(capacity, bool) or capacity < 1:
        raise SpecError(where, f"capacity must be a whole number of messages >= 1, not {capacity!r}")
    if overflow not in get_args(Overflow):
        raise SpecError(where, f"overflow must be one of {', '.join(get_args(Overflow))}, not {overflow!r}")
