"""The arbiter: grants an actor to its supervisor, to failover or to repair, never to two of them (T63).

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
from collections.abc import Callable, Generator, Iterable, Iterator
from typing import Final

from ..actors.errors import HoldfastError
from ..actors.events import ChildRestarted, Event, SupervisorGaveUp
from ..actors.kernel.cell import DOWN, ENDING, GONE, Cell
from ..actors.kernel.node import Node
from .children import RECOVERING, RESTARTING, STOPPED, UP, Child
from .supervisor import Supervisor

SUPERVISOR: Final = "its supervisor"
OPERATOR: Final = "an operator"
"""In whose hands is what was stopped by order."""
AGAIN: Final = (RESTARTING, RECOVERING)


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


class InOtherHands(HoldfastError, text="{address} is in the hands of {hand}: {reason}"):
    """Somebody else acts on the address, or on one above or below it: `hand` does, because of `reason`."""

    address: str
    hand: str
    reason: str


class GrantLost(HoldfastError, text="the grant of {address} (epoch {epoch}) is lost: {reason}"):
    """The grant of this epoch does not count any more: `reason` says who has the address now, or that time is up."""

    address: str
    epoch: int
    reason: str


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
        self._escalating: dict[str, tuple[Cell, int]] = {}
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
        return self._supervised(address) if hand is Hand.REPAIR else None

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
        """A supervisor restarts a child, or gives up: who goes behind it loses what is below."""
        if isinstance(event, ChildRestarted):
            self._is_at(event.address, f"its supervisor restarts {event.address}: {event.reason}")
        elif isinstance(event, SupervisorGaveUp):
            cell = None if self._node is None else self._node.find(event.address)
            if cell is not None:
                self._escalating[event.address] = cell, cell.life
            self._is_at(event.address, f"{event.address} gives up")

    def _is_at(self, address: str, reason: str) -> None:
        """A supervisor is at work."""
        for grant in list(self._overlapping(address)):
            if Hand.SUPERVISOR.goes_before(grant.hand):
                self._take_away(grant, reason)

    def _supervised(self, address: str) -> InOtherHands | None:
        """Who at, above or below the address is in its supervisor's hands, or was stopped by order."""
        if self._node is None:
            return None
        if (above := self._escalation(address)) is not None:
            return InOtherHands(above, SUPERVISOR, "it gives up, and all below it end")
        return self._covered(address) or next(_below(self._node.find(address)), None)

    def _escalation(self, address: str) -> str | None:
        """The supervisor at, above or below the address that has given up, and whose life is not over yet."""
        assert self._node is not None
        for where, (cell, life) in list(self._escalating.items()):
            if self._node.find(where) is not cell or cell.life != life or cell.state in (DOWN, GONE):
                del self._escalating[where]  # From here on its own supervisor says what it does with it.
            elif covers(where, address) or covers(address, where):
                return where
        return None

    def _covered(self, address: str) -> InOtherHands | None:
        node, at = self._node, ""
        if node is None:
            return None
        for name in address.split("/")[1:]:  # From above: of what has gone, only its supervisor knows.
            above, at = at, f"{at}/{name}"
            if (busy := _in_hands(node.find(above), name)) is not None:
                return busy
        return None

    def has_parked(self, address: str) -> bool:
        """Whether it, somebody above it or somebody below it was stopped by order, and not started since."""
        below = None if self._node is None else self._node.find(address)
        return self.is_parked(address) or any(busy.hand == OPERATOR for busy in _below(below))

    def is_parked(self, address: str) -> bool:
        """Whether it, or a supervisor above it, was stopped by order, and not started since."""
        busy = self._covered(address)
        return busy is not None and busy.hand == OPERATOR


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


def _in_hands(above: Cell | None, name: str) -> InOtherHands | None:
    """Whether somebody else has to do with a child just now; of one that nobody supervises, nobody has."""
    keeper = None if above is None else above.actor
    if above is None or not isinstance(keeper, Supervisor):
        return None
    path, child, cell = f"{above.path}/{name}", keeper._listed().get(name), (above.children or {}).get(name)
    if child is None or child.state == STOPPED:
        return InOtherHands(path, OPERATOR, "it was stopped by order") if keeper._is_parked(name) else None
    if child.state != UP:
        return InOtherHands(path, SUPERVISOR, f"it is {'being restarted' if child.state in AGAIN else child.state}")
    if cell is not None and cell.state in (ENDING, DOWN) and not _hangs_in_its_end(child, cell):
        return InOtherHands(path, SUPERVISOR, "it is ending")
    return None


def _hangs_in_its_end(child: Child, cell: Cell) -> bool:
    """Whether it ends by itself, and has waited for something longer than its supervisor gives it to stop.

    Its supervisor has not told it to, and so sets it no limit.
    """
    turn = None if cell.more is None else cell.more.turn
    if cell.state != ENDING or turn is None or isinstance(child.spec.shutdown, str):
        return False
    return cell.node.loop.time() - turn.since > child.spec.shutdown


def _below(cell: Cell | None) -> Iterator[InOtherHands]:
    """Those below it who are in the hands of others."""
    if cell is None:
        return
    parked: Iterable[str] = cell.actor._all_parked() if isinstance(cell.actor, Supervisor) else ()
    living = cell.children or {}
    for name in [*living, *(name for name in parked if name not in living)]:
        busy = _in_hands(cell, name)
        if busy is not None:
            yield busy
        yield from _below(living.get(name))
