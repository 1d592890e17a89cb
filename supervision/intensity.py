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


class CountedCauses:
    """The common causes for which a supervisor has counted a restart, and the children that it stands for.

    The ends of several children by one cause are one fault; that a child ends by it once more is another one.
    """

    def __init__(self) -> None:
        self._counted: dict[str, tuple[float, set[str]]] = {}  # when it was counted, and the ids of the children

    def is_counted(self, cause: str, child: str, now: float, period: float) -> bool:
        """Say whether the restart of a child is counted with that of another one; from now on it stands for both.

        Args:
            cause: the common cause of the end; "" is none.
            child: its id.
            now: time of this restart, in seconds on the loop clock.
            period: window length in seconds.

        >>> causes = CountedCauses()
        >>> [causes.is_counted("fork server 7", child, 1.0, 5.0) for child in ("a", "b", "b")]
        [False, True, False]
        >>> causes.is_counted("fork server 7", "c", 9.0, 5.0), causes.is_counted("", "a", 9.0, 5.0)
        (False, False)
        """
        self._counted = {of: one for of, one in self._counted.items() if now - one[0] <= period}
        if not cause:
            return False
        at, children = self._counted.get(cause, (now, set[str]()))
        is_new = cause not in self._counted or child in children
        self._counted[cause] = (now, {child}) if is_new else (at, children | {child})
        return not is_new


def recent_restarts(restarts: tuple[float, ...], now: float, period: float) -> tuple[float, ...]:
    """Those of the restarts, oldest first, that are not longer than `period` ago.

    >>> recent_restarts((0.0, 4.0), 5.0, 3.0)
    (4.0,)
    """
    old, count = 0, len(restarts)
    while old < count and now - restarts[old] > period:
        old += 1
    return restarts[old:]
