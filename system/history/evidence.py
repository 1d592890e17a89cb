"""The evidence about one address: what the history, its supervisor, its mailbox and its asks say of it, as data."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import TYPE_CHECKING

import msgspec

from ...actors.control.orders import Status
from ...actors.kernel.cell import GONE
from ...actors.kernel.envelope import Ask, message_in
from ...actors.process.process_host import Outlet
from ...supervision.intensity import recent_restarts
from ...supervision.supervisor import Supervisor
from .lives import PastLife
from .pages import answer, question
from .past_event import PastEvent, content, message_type, shortened

if TYPE_CHECKING:
    from ...actors.kernel.cell import Cell
    from ...actors.kernel.node import Node
    from ...checkpoint.home.quarantine import QuarantinedMessage
    from .recorder import HistoryRecorder

STORE_KINDS = ("JournalBlocked", "JournalFull", "JournalGoesOn", "JournalStopped", "HistoryNotKept")
"""Events that say how the store is."""
GAVE_UP_KINDS = ("SupervisorGaveUp", "AutoShutdown")
"""Events of supervisors that end with all below them."""
MOST_LOOKED_AT = 50_000
"""Actors and messages in mailboxes that are looked at for asks of one actor."""
MOST = 200
"""Events of the address that are looked at, the newest."""


class Outstanding(msgspec.Struct, frozen=True):
    """An ask of an actor that has no answer yet: whom it has asked what, and how long ago in seconds."""

    to: str
    message: str
    seconds: float


class Allowance(msgspec.Struct, frozen=True):
    """What a supervisor allows: `intensity` restarts within `period` seconds, of which it has counted `restarts`."""

    intensity: int
    period: float
    restarts: int


class PutAside(msgspec.Struct, frozen=True):
    """A message in quarantine, as it is told to those who look.

    Attributes:
        address: whose message it is.
        message: its type; of what the runtime itself brings ("tick", "exit", "down", "pipe"), that.
        attempts: how often it has ended the process.
        since: Unix time at which it was put aside.
        sender: the address of who sent it; "" if no actor has.
        id: its number at the address.
        payload: what is in it, with `log_payloads`.
    """

    address: str
    message: str
    attempts: int
    since: float
    sender: str = ""
    id: int = 0
    payload: str = ""


class Evidence(msgspec.Struct, frozen=True):
    """All that is known about an address at one moment.

    Attributes:
        address: whom it is about.
        now: Unix time.
        is_there: whether the address has an actor now, or will have one again.
        lives: the newest lives, oldest first.
        events: the newest events about the address, oldest first.
        above: the newest events of supervisors above it that gave up.
        store: the newest events about the store.
        status: how the actor is; None if nobody lives there, or it does not say.
        queued_before: how many messages waited a moment before the status was taken; None: nobody has looked.
        asks: its asks that have no answer yet, as far as this process knows them.
        allowance: what its supervisor allows, if that is in this process.
        quarantined: its messages in quarantine.
        suspects_gap: whether events were left out lately because there were too many.
    """

    address: str
    now: float
    is_there: bool = False
    lives: list[PastLife] = []
    events: list[PastEvent] = []
    above: list[PastEvent] = []
    store: list[PastEvent] = []
    status: Status | None = None
    queued_before: int | None = None
    asks: list[Outstanding] = []
    allowance: Allowance | None = None
    quarantined: list[PutAside] = []
    suspects_gap: bool = False


def collect(
    node: Node,
    recorder: HistoryRecorder,
    address: str,
    status: Status | None,
    queued_before: int | None,
    quarantined: list[QuarantinedMessage],
) -> Evidence:
    """All that is known about an address now."""
    cell = node.find(address)
    above = address.rpartition("/")[0]
    ancestors: list[PastEvent] = []
    while above:
        ancestors += answer(recorder, question(literal(above), kinds=GAVE_UP_KINDS, limit=5)).events
        above = above.rpartition("/")[0]
    return Evidence(
        address,
        node.clock.wall(),
        cell is not None and cell.state is not GONE,
        recorder.lives.at(address),
        answer(recorder, question(literal(address), limit=MOST)).events,
        sorted(ancestors, key=lambda event: event.number),
        answer(recorder, question(kinds=STORE_KINDS, limit=20)).events,
        status,
        queued_before,
        outstanding(node, address),
        None if cell is None else _allowance(cell),
        [put_aside(one) for one in quarantined],
        recorder.is_in_storm,
    )


def put_aside(one: QuarantinedMessage, *, payloads: bool = False) -> PutAside:
    """A message in quarantine as plain data; what is in it only with `payloads`."""
    name = one.kind if one.message is None else message_type(one.message)
    payload = shortened(content(one.message)) if payloads and one.message is not None else ""
    return PutAside(one.address, name, one.attempts, one.since, one.sender or "", one.id, payload)


def outstanding(node: Node, address: str) -> list[Outstanding]:
    """The asks of an actor that have no answer yet, the oldest first."""
    now = node.loop.time()
    asks = {id(ask): (ask.to.path, ask) for ask in node.deadlines.waiting()}
    asks.update((id(ask), (path, ask)) for path, ask in _in_mailboxes(node))
    found = [
        Outstanding(to, message_type(message_in(ask)), max(0.0, now - (ask.deadline - ask.timeout)))
        for to, ask in asks.values()
        if ask.sender is not None and ask.sender.path == address
    ]
    return sorted(found, key=lambda one: -one.seconds)


def _in_mailboxes(node: Node) -> Iterator[tuple[str, Ask]]:
    """The asks that actors have in hand or in their mailboxes, also those that go from one process to another."""
    left, cells = MOST_LOOKED_AT, [] if node.root is None else [node.root]
    while cells and left > 0:
        cell = cells.pop()
        cells.extend((cell.children or {}).values())
        outlet = cell.more.outlet if cell.more is not None else None
        sent = [item for _, item in outlet.flight] if isinstance(outlet, Outlet) else []
        items = [cell.item, *itertools.islice(itertools.chain(sent, cell.queue or ()), left)]
        left -= len(items)
        yield from ((cell.path, item) for item in items if isinstance(item, Ask) and not item.is_done)


def _allowance(cell: Cell) -> Allowance | None:
    above = cell.parent.actor if cell.parent is not None else None
    if cell.spec is None or not isinstance(above, Supervisor) or "_flags" not in above.__dict__:
        return None
    flags = above._flags
    restarts = recent_restarts(above._restarts, cell.node.loop.time(), flags.period)
    return Allowance(flags.intensity, flags.period, len(restarts))


def literal(address: str) -> str:
    """A pattern that means just this address, whatever signs are in it."""
    return "".join(f"[{sign}]" if sign in "*?[" else sign for sign in address)
