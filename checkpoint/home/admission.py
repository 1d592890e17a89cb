"""Admission to the journal: a message from outside counts once it is as safe as it has to be."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import msgspec

from ...actors.errors import HoldfastError
from ...actors.exit_reasons import pack_exit
from ...actors.kernel import links
from ..protocol import DOWN, EXIT, MESSAGE
from .disposal import lose

if TYPE_CHECKING:
    from ...actors.kernel.envelope import Item
    from ..inputs import Input
    from .switch import Switch


class InputAdmission:
    """One input that stands alone in its submission."""

    __slots__ = ("_accepted", "_home", "_source", "entries")

    def __init__(self, home: Switch, source: Input) -> None:
        self._home, self._source = home, source
        self.entries = ((home.path, source.entry()),)
        self._accepted: asyncio.Future[None] | None = None

    def accepted(self) -> asyncio.Future[None]:
        """For a sender that waits until it counts."""
        self._accepted = self._home.node.loop.create_future()
        return self._accepted

    def written(self, positions: Sequence[int]) -> None:
        """It stands there in the journal."""
        self._source.positions.append(positions[0])

    def safe(self) -> None:
        """It counts, and is fed."""
        self._home.admitted(self._source)
        if self._accepted is not None and not self._accepted.done():
            self._accepted.set_result(None)

    def refused(self, error: HoldfastError) -> bool:
        """It was not written: nobody has heard of it. What comes from the runtime itself waits."""
        if not take_back(self._home, self._source, error, told=self._accepted is not None):
            return False
        if self._accepted is not None and not self._accepted.done():
            self._accepted.set_exception(error)
            self._accepted.exception()  # The sender may have gone.
        return True

    def abandoned(self, error: HoldfastError) -> None:
        """Nobody waits for what comes from the runtime itself."""


def submit(home: Switch, source: Input) -> None:
    """Have an input journaled.

    Raises:
        HoldfastError: it comes from outside, and the store takes nothing now.
    """
    admission = InputAdmission(home, source)
    if source.kind != MESSAGE:
        home.journal.submit(admission)
        return
    try:
        home.journal.admit(admission)
    except HoldfastError:
        _forget(home, source)
        raise


def take_back(home: Switch, source: Input, error: HoldfastError, *, told: bool) -> bool:
    """The store refused an input; False if it has happened all the same. `told`: its sender hears of it."""
    if source.kind != MESSAGE:
        return False
    if _forget(home, source):
        ask, source.ask = source.ask, None
        if ask is not None:
            ask.started = False
            ask.fail(error)
        elif not told:
            lose(home, source, str(error))
    return True


def _forget(home: Switch, source: Input) -> bool:
    """An input was not admitted after all; False if it has ended meanwhile."""
    is_open = home.ledger.withdraw(source)
    if is_open and home.intake.bound is not None:
        home.intake.bound.ended(source)
    return is_open


def taken_up(home: Switch, item: Item) -> tuple[str, str, bytes] | None:
    """An EXIT or DOWN as the input that it becomes: kind, name and body; None if nobody waits for it any more.

    Raises:
        HoldfastError: it is something else.
    """
    if isinstance(item, links.Exit):
        data: dict[str, Any] = {"source": item.source.path, "reason": pack_exit(item.reason)}
        home.ties.over("link", item.source.path)
        return EXIT, "", msgspec.msgpack.encode(data)
    if not isinstance(item, links.Down):
        raise HoldfastError(f"{type(item).__name__} cannot be journaled for {home.path}")
    if not item.watch.active:
        return None
    verb, target = "watch" if item.watch.for_good else "monitor", item.watch.target.path
    data = {"source": target, "reason": pack_exit(item.reason), "recovering": item.recovering, "verb": verb}
    if not item.recovering:
        home.ties.over(verb, target)
    return DOWN, "", msgspec.msgpack.encode(data)
