"""The arbiter: an actor is in the hands of its supervisor, of failover, or of repair, never of two (T63).

Failover goes first, then the supervisor, then repair. Failover and repair ask for a *grant* before they touch an actor
or a subtree, and give it back; a supervisor asks nobody: while it restarts a child, that child is its own. A grant has
an epoch, which rises with each one; whoever holds an old one has lost the actor, and is told so.

Whoever changes a mechanism asks too (`ADAPTATION`). It goes neither before repair nor behind it: the first one has the
actor. Failover and supervisor do not take it away; it rests while they are at it, and goes on when they are done.
"""

from __future__ import annotations

import contextlib
import contextvars
import dataclasses
import enum
import itertools
import math
from collections.abc import Callable, Generator, Iterator

from ..actors.cell import Cell
from ..actors.errors import HoldfastError
from ..actors.events import ChildRestarted, Event
from ..actors.node import Node
from .children import RECOVERING, RESTARTING
from .supervisor import Supervisor


class Hand(enum.IntEnum):
    """Who may hold an actor; the lower number goes first."""

    FAILOVER = 0
    SUPERVISOR = 1
    ADAPTATION = 2
    REPAIR = 3

    def goes_before(self, other: Hand) -> bool:
        """Whether this one takes the actor from the other: of adaptation and repair, the first one has it."""
        return self < other and self < Hand.ADAPTATION and other is not Hand.ADAPTATION

    def goes_beside(self, other: Hand) -> bool:
        """Whether both may have the actor: an adaptation rests while failover or its supervisor is at it."""
        return Hand.ADAPTATION in (self, other) and min(self, other) < Hand.ADAPTATION


on_errand: contextvars.ContextVar[object] = contextvars.ContextVar("on_errand", default=None)
"""What is being done here: a repair step, a transaction. Grants of one errand do not exclude each other, so that repair
can have a mechanism changed for it."""


@dataclasses.dataclass(frozen=True, slots=True)
class Grant:
    """The right to act on an address, and on all below it.

    Attributes:
        epoch: rises with each grant; an action carries it, so that it is seen that it comes too late.
        until: seconds on the loop clock; after that nobody holds it any more.
        errand: what it belongs to.
    """

    address: str
    hand: Hand
    epoch: int
    reason: str
    until: float = math.inf
    errand: object = dataclasses.field(default=None, repr=False, compare=False)


class InOtherHands(HoldfastError):
    """Somebody else acts on the address, or on one above or below it: `hand` does, because of `reason`."""

    def __init__(self, address: str, hand: str, reason: str) -> None:
        super().__init__(address, hand, reason)
        self.address, self.hand, self.reason = address, hand, reason

    def __str__(self) -> str:
        return f"{self.address} is in the hands of {self.hand}: {self.reason}"


class GrantLost(HoldfastError):
    """The grant of this epoch does not count any more: `reason` says who has the address now, or that time is up."""

    def __init__(self, address: str, epoch: int, reason: str) -> None:
        super().__init__(address, epoch, reason)
        self.address, self.epoch, self.reason = address, epoch, reason

    def __str__(self) -> str:
        return f"the grant of {self.address} (epoch {self.epoch}) is lost: {self.reason}"


class Arbiter:
    """Grants addresses. One for each system: `arbiter_of(node)`.

    Args:
        clock: seconds, as the loop counts them.
        node: whose supervisors are looked at; None if there are none.
    """

    def __init__(self, clock: Callable[[], float], node: Node | None = None) -> None:
        self._clock, self._node = clock, node
        self._grants: dict[int, tuple[Grant, Callable[[str], None] | None]] = {}
        self._epochs = itertools.count(1)
        if node is not None:
            node.events.add_sink(self._heard)

    def claim(
        self,
        address: str,
        hand: Hand,
        reason: str,
        *,
        seconds: float = math.inf,
        lost: Callable[[str], None] | None = None,
        errand: object = None,
    ) -> Grant:
        """The right to act on an address and on all below it; who goes behind `hand` loses what overlaps.

        Args:
            address: of an actor or a supervisor; any other text stands for itself.
            hand: who asks.
            reason: why; told to who is refused meanwhile.
            seconds: it ends by itself after so many.
            lost: called once, at once, with the reason, if somebody else takes it before it is given back.
            errand: what this is part of; what `on_errand` says if it is left out.

        Raises:
            InOtherHands: somebody who goes first, or as far in front, is at it.
        """
        errand = on_errand.get() if errand is None else errand
        if (busy := self._in_the_way(address, hand, errand)) is not None:
            raise busy
        for other in list(self._overlapping(address)):
            if hand.goes_before(other.hand) and not _is_one(errand, other):
                self._take_away(other, f"{hand.name.lower()} has it now: {reason}")
        grant = Grant(address, hand, next(self._epochs), reason, self._clock() + seconds, errand)
        self._grants[grant.epoch] = grant, lost
        return grant

    def in_the_way(self, address: str, hand: Hand) -> InOtherHands | None:
        """Who would refuse a claim now; None: nobody."""
        return self._in_the_way(address, hand, on_errand.get())

    def _in_the_way(self, address: str, hand: Hand, errand: object) -> InOtherHands | None:
        for other in list(self._overlapping(address)):
            if not (_is_one(errand, other) or hand.goes_before(other.hand) or hand.goes_beside(other.hand)):
                return InOtherHands(other.address, other.hand.name.lower(), other.reason)
        # An adaptation waits by itself until its actor is up.
        if hand is Hand.REPAIR and (busy := self._supervised(address)) is not None:
            return InOtherHands(busy, "its supervisor", "it is being restarted")
        return None

    @contextlib.contextmanager
    def held(
        self, address: str, hand: Hand, reason: str, *, lost: Callable[[str], None] | None = None
    ) -> Generator[Grant]:
        """A grant for a block. Raises InOtherHands."""
        grant = self.claim(address, hand, reason, lost=lost)
        try:
            yield grant
        finally:
            self.release(grant)

    def release(self, grant: Grant) -> None:
        """Give it back; of a lost one nothing is left to give."""
        self._grants.pop(grant.epoch, None)

    def check(self, grant: Grant) -> None:
        """Raises GrantLost: it does not count any more."""
        if grant.epoch not in self._grants:
            raise GrantLost(grant.address, grant.epoch, "it was taken away or given back")
        if grant.until < self._clock():
            raise GrantLost(grant.address, grant.epoch, "its time is up")

    def holder(self, address: str) -> Grant | None:
        """The grant that covers the address, if there is one."""
        return next((one for one in self._overlapping(address) if covers(one.address, address)), None)

    def _overlapping(self, address: str) -> Iterator[Grant]:
        now = self._clock()
        for grant, _ in list(self._grants.values()):
            if grant.until < now:
                self._take_away(grant, "its time is up")
            elif covers(grant.address, address) or covers(address, grant.address):
                yield grant

    def _take_away(self, grant: Grant, reason: str) -> None:
        _, lost = self._grants.pop(grant.epoch, (grant, None))
        if lost is not None:
            lost(reason)

    def _heard(self, event: Event) -> None:
        """A supervisor restarts a child: who goes behind it loses the child."""
        if isinstance(event, ChildRestarted):
            for grant in list(self._overlapping(event.address)):
                if Hand.SUPERVISOR.goes_before(grant.hand):
                    self._take_away(grant, f"its supervisor restarts {event.address}: {event.reason}")

    def _supervised(self, address: str) -> str | None:
        """Who at, above or below the address is being restarted by its supervisor, or brought back."""
        cell = self._node.find(address) if self._node is not None else None
        above = cell
        while above is not None:
            if _is_being_restarted(above):
                return above.path
            above = above.parent
        return next((one.path for one in _below(cell) if _is_being_restarted(one)), None)


def covers(above: str, address: str) -> bool:
    """Whether `address` is `above`, or below it.

    >>> covers("/app/a", "/app/a/b"), covers("/app/a", "/app/ab")
    (True, False)
    """
    return address == above or address.startswith(f"{above}/")


def arbiter_of(node: Node) -> Arbiter:
    """The one arbiter of a system, made when it is first asked for."""
    if node.arbiter is None:
        node.arbiter = Arbiter(node.loop.time, node)
    arbiter: Arbiter = node.arbiter
    return arbiter


def _is_one(errand: object, grant: Grant) -> bool:
    return errand is not None and grant.errand is errand


def _is_being_restarted(cell: Cell) -> bool:
    keeper = cell.parent.actor if cell.parent is not None else None
    child = keeper._children.get(cell.name) if isinstance(keeper, Supervisor) else None
    return child is not None and child.cell is cell and child.state in (RESTARTING, RECOVERING)


def _below(cell: Cell | None) -> Iterator[Cell]:
    for one in list((cell.children or {}).values()) if cell is not None else ():
        yield one
        yield from _below(one)
