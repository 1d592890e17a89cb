"""Restart intensity: how many restarts are too many."""

from __future__ import annotations


def admit_restart(
    restarts: tuple[float, ...], now: float, *, intensity: int, period: float
) -> tuple[float, ...] | None:
    """Admit one more restart, or report that the limit is reached.

    Args:
        restarts: times of earlier restarts, in seconds on the loop clock, oldest first.
        now: time of this restart, same clock, not before `restarts[-1]`.
        intensity: restarts allowed within one period; 0 allows none.
        period: window length in seconds, > 0; both ends count.

    Returns:
        The restarts still in the window, this one included; `None` once the limit is reached.

    Source:
        Erlang/OTP `supervisor`, maximum restart intensity.

    >>> admit_restart((0.0, 4.0), 5.0, intensity=2, period=3.0)
    (4.0, 5.0)
    >>> admit_restart((3.0, 4.0), 5.0, intensity=2, period=3.0) is None
    True
    """
    recent = (*recent_restarts(restarts, now, period), now)
    return recent if len(recent) <= intensity else None


def recent_restarts(restarts: tuple[float, ...], now: float, period: float) -> tuple[float, ...]:
    """Those of the restarts, oldest first, that are not longer than `period` ago.

    >>> recent_restarts((0.0, 4.0), 5.0, 3.0)
    (4.0,)
    """
    old, count = 0, len(restarts)
    while old < count and now - restarts[old] > period:
        old += 1
    return restarts[old:]
