"""Expectations of a test about its actors, from its markers and from the configuration of pytest."""

from __future__ import annotations

from contextvars import ContextVar
from typing import TYPE_CHECKING, Any

from ..actors.errors import SpecError

if TYPE_CHECKING:
    import pytest

    from .guarded import GuardedSystem
    from .schedules.failures import Failures

LEAKS = frozenset({"descriptors", "generators", "processes", "signals", "tasks", "threads", "timers"})
"""What a test can leave behind."""


class SystemsWanted:
    """What a test may do to its systems, and the options of these.

    Attributes:
        options: for ActorSystem.
        leaks: what may be left behind, of `LEAKS`.
        exceptions: whether exceptions may go unseen.
        nodeid: of the test, as pytest names it; empty outside of pytest.
    """

    def __init__(self, item: pytest.Item | None = None, expectable: tuple[str, ...] = ()) -> None:
        self.options: dict[str, Any] = {}
        self._config = None if item is None else item.config
        self.nodeid = "" if item is None else item.nodeid
        self._expected: dict[str, Any] = {}
        if item is not None:
            self._expected.update(dict.fromkeys(item.config.getini("holdfast_expect"), True))
            for marker in reversed(list(item.iter_markers("holdfast"))):  # The closest one has the last word.
                for name, value in marker.kwargs.items():
                    (self._expected if name in expectable else self.options)[name] = value
        self.leaks = _kinds(self._expected.get("leaks"))
        self.exceptions = self.expects("exceptions")

    def option(self, name: str) -> Any:
        """What the command line of pytest says, as `--holdfast-{name}`; None: nothing."""
        return None if self._config is None else self._config.getoption(f"holdfast_{name}", None)

    def failures(self) -> Failures | None:
        """The schedules that have failed the test; None outside of pytest."""
        from .schedules.failures import Failures

        return None if self._config is None else Failures(self._config, self.nodeid)

    def expects(self, what: str) -> bool:
        """Whether the test expects this, one of `EXPECTABLE`, at all."""
        return bool(self._expected.get(what))

    def tell(self, system: GuardedSystem) -> None:
        """Let a system know what it may see."""
        if not self._expected:
            return
        for name, expect in (("dead_letters", system.expect_dead_letters), ("crashes", system.expect_crashes)):
            value = self._expected.get(name, False)
            if value is True:
                expect(None)
            elif value:
                expect(int(value))
        for name, allow in (
            ("sends", system.expect_sends),
            ("replies", system.expect_replies),
            ("types", system.expect_types),
            ("exceptions", system.expect_exceptions),
        ):
            if self.expects(name):
                allow()


def _kinds(said: Any) -> frozenset[str]:
    """What may be left behind, from what a marker says: True, one kind, or several.

    >>> sorted(_kinds(("threads", "timers")))
    ['threads', 'timers']
    """
    if not said:
        return frozenset()
    kinds = LEAKS if said is True else frozenset((said,) if isinstance(said, str) else said)
    if unknown := sorted(kinds - LEAKS):
        raise SpecError("leaks", f"{unknown[0]!r} is none of {', '.join(sorted(LEAKS))}")
    return kinds


running: ContextVar[SystemsWanted] = ContextVar("holdfast test", default=SystemsWanted())  # noqa: B039  # it is never changed
"""Of the test that pytest runs now."""
