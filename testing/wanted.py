"""What a test expects of its actors: what its markers and the configuration of pytest say."""

from __future__ import annotations

from contextvars import ContextVar
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pytest

    from .guarded import GuardedSystem


class Wanted:
    """What a test may do to its systems, and the options of these.

    Attributes:
        options: for ActorSystem.
        leaks: whether anything may be left behind.
    """

    def __init__(self, item: pytest.Item | None = None, expectable: tuple[str, ...] = ()) -> None:
        self.options: dict[str, Any] = {}
        self._expected: dict[str, Any] = {}
        if item is not None:
            self._expected.update(dict.fromkeys(item.config.getini("holdfast_expect"), True))
            for marker in reversed(list(item.iter_markers("holdfast"))):  # The closest one has the last word.
                for name, value in marker.kwargs.items():
                    (self._expected if name in expectable else self.options)[name] = value
        self.leaks = bool(self._expected.get("leaks"))

    def tell(self, system: GuardedSystem) -> None:
        """Let a system know what it may see."""
        for name, expect in (("dead_letters", system.expect_dead_letters), ("crashes", system.expect_crashes)):
            value = self._expected.get(name, False)
            if value is True:
                expect(None)
            elif value:
                expect(int(value))
        if self._expected.get("sends"):
            system.expect_sends()


running: ContextVar[Wanted] = ContextVar("holdfast test", default=Wanted())  # noqa: B039  # it is never changed
"""Of the test that pytest runs now."""
