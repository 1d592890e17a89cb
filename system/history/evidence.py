"""The evidence about one address: what the history, its supervisor, its mailbox and its asks say of it, as data."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Iterator
from itertools import islice
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from ...actors.control.orders import Status, status_of
from ...actors.errors import DIVERGES
from ...actors.kernel.cell import GONE
from ...actors.kernel.envelope import NO_DEADLINE, Ask, Item, message_in
from ...actors.process.open_asks import items_at, open_asks
from ...checkpoint.home.recorded_home import switch_of
from ...checkpoint.protocol import MESSAGE
from ...ftm.group.protected import ProtectionStatus, protection_of
from ...supervision.children import STOPPED
from ...supervision.intensity import recent_restarts
from ...supervision.spec import ChildSpec
from ...supervision.supervisor import IN_VAIN, Supervisor, listed_at
from .lives import WITH_THE_ROOT, PastLife, is_deeper, is_fault
from .pages import answer, question
from .past_event import PastEvent, content, message_type, shortened
from .paths import PARTS, is_part, literal

if TYPE_CHECKING:
    from ...actors.kernel.cell import Cell
    from ...actors.kernel.node import Node
    from ...checkpoint.home.quarantine import QuarantinedMessage
    from .recorder import HistoryRecorder

STORE_KINDS = (
    "HistoryNotKept",
    "JournalBlocked",
    "JournalFull",
    "JournalGoesOn",
    "JournalStopped",
    "LeadershipTaken",
    "ServersAnswer",
    "ServersSilent",
)
"""Events that say how the store is."""
GAVE_UP_KINDS = ("SupervisorGaveUp", "AutoShutdown")
"""Events of supervisors that end with all below them."""
MOST_LOOKED_AT = 50_000
"""Actors and messages in mailboxes that are looked at for asks of one actor."""
FIRST = 100
"""Messages that are looked at for one that has waited for long, of each that is below a supervisor."""
MOST = 200
"""Events of the address that are looked at, the newest."""
MOST_DEEPER = 10_000
"""Actors below a supervisor that are looked at."""
MOST_TEXT = 300
"""Characters of an error that a sentence quotes."""
ADVICE = (DIVERGES, IN_VAIN)
"""What errors say at their end, of what is to be done: nothing that a sentence about many has room for."""
LONG_TURN = 1.0
"""Seconds from which on a turn, or the wait of a message, is worth a sentence."""
MADE_GOOD = (*GAVE_UP_KINDS, "RecoveryFailed")
"""Events that a life which begins behind them makes good."""
START_KINDS = ("ChildRestarted", "ChildStartFailed")
"""Events of a child that is started again, of which the next program knows nothing."""
NEWS_KINDS = (*START_KINDS, "JournalFull", "MessageQuarantined", "RecoveryFailed", "ReplicaLost")
DEEPER_KINDS = (*GAVE_UP_KINDS, *NEWS_KINDS)
"""Events further below a supervisor of which it tells, too."""
CHILD_KINDS = (*NEWS_KINDS, "StopOverdue")
"""Events of children that their supervisor is asked about, too."""


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


class ChildNow(msgspec.Struct, frozen=True):
    """A child as its supervisor sees it at this moment.

    Attributes:
        name: the last part of its address.
        state: "running", "suspended", "starting", "restarting", "recovering", "stopping" or "stopped".
        turn: the message whose turn waits, by type; "" if none does, or another process has not said so.
        turn_seconds: how long that turn has taken so far.
        turn_at: the line of the user's code at which it waits.
        awaited: the address for which its start waits, because it is bound to it.
        queued: messages that wait for it.
        waited: seconds for which one of them has waited at least; 0 if that is not known.
        rests: what its turn rests in, as it has said, while nobody waits for an answer of it; "" if it does not.
    """

    name: str
    state: str
    turn: str = ""
    turn_seconds: float = 0.0
    turn_at: str = ""
    awaited: str = ""
    queued: int = 0
    waited: float = 0.0
    rests: str = ""

    @property
    def is_long(self) -> bool:
        """Whether its turn, or a message that waits for it, takes long enough for a sentence."""
        return bool(self.turn and self.turn_seconds >= LONG_TURN) or self.waited >= LONG_TURN

    @property
    def is_slow(self) -> bool:
        """Whether it takes long enough, and is not a rest."""
        return self.is_long and not self.rests


class ProcessMemory(msgspec.Struct, frozen=True):
    """The resident memory of an actor's own process, and what its limits allow; both in bytes."""

    resident_bytes: int
    allowed_bytes: int


class Waiting(msgspec.Struct, frozen=True):
    """What waits in a mailbox.

    Attributes:
        message: the commonest type.
        count: how many of that type there are.
        sender: one of their senders, or "".
        waited: seconds for which one of them has waited at least; 0 if that is not known.
        late: asks whose time is over, so that nobody waits for their answers any more.
        asked: seconds for which an ask has waited at least; 0 if that is not known.
        mean_turn: seconds that a turn takes in the mean; 0 if statistics are off, or another process has them.
    """

    message: str
    count: int
    sender: str = ""
    waited: float = 0.0
    late: int = 0
    mean_turn: float = 0.0
    asked: float = 0.0

    @property
    def is_in_vain(self) -> bool:
        """Whether somebody who has asked waits for long, or has given up."""
        return self.asked >= LONG_TURN or self.late > 0


class Below(msgspec.Struct, frozen=True):
    """What is known of those at one distance below a supervisor.

    Attributes:
        events: the newest about what weighs much there, oldest first.
        now: those that are there: its children by name; further below, by address, only those that do not get on.
        ended: the last lives of those that are not there now, by address; further below only ends by a fault.
    """

    events: list[PastEvent] = []
    now: list[ChildNow] = []
    ended: dict[str, PastLife] = {}


class Silence(msgspec.Struct, frozen=True):
    """An actor in another process has not answered a question that is answered ahead of all messages.

    Attributes:
        pid: of its process.
        seconds: for which it was waited.
        is_stopped: the kernel lets the process do nothing, as after SIGSTOP.
    """

    pid: int
    seconds: float
    is_stopped: bool


class OwnProcess(msgspec.Struct, frozen=True):
    """The process of an actor.

    Attributes:
        memory: what it takes, if the limits of the actor bound that.
        silence: that it has not answered.
    """

    memory: ProcessMemory | None = None
    silence: Silence | None = None


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
        allowance: what its supervisor allows, if that says so.
        quarantined: its messages in quarantine.
        suspects_gap: whether events were left out lately because there were too many.
        below: its children, if it is a supervisor that answers.
        deeper: whoever is further below, at any depth, as far as this process knows.
        own_allowance: what it allows itself, if it is a supervisor that answers.
        protection: its mechanisms and replicas, if somebody lives there.
        process: what is known of its own process.
        waiting: what waits in its mailbox.
        awaited: the address for which its start waits, because it is bound to it; "" if it does not wait so.
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
    below: Below = Below()
    deeper: Below = Below()
    own_allowance: Allowance | None = None
    protection: ProtectionStatus | None = None
    process: OwnProcess = OwnProcess()
    waiting: Waiting | None = None
    awaited: str = ""

    @property
    def rests(self) -> bool:
        """Whether its turn rests, as it has said, and nobody waits for an answer meanwhile."""
        is_asked = self.waiting is not None and self.waiting.is_in_vain
        return bool(self.status and self.status.turn_rests) and not self.asks and not is_asked

    def ago(self, at: float) -> str:
        """A moment as people say it: how long ago, or the time of day if that is long."""
        seconds = self.now - at
        if seconds < 120.0:
            return f"{seconds_text(max(0.0, seconds))} ago"
        return f"at {time.strftime('%Y-%m-%d %H:%M:%S', time.localtime(at))}"


def seconds_text(seconds: float) -> str:
    """Seconds as people say them.

    >>> seconds_text(12.3), seconds_text(1.23)
    ('12 s', '1.2 s')
    """
    return f"{seconds:.0f} s" if seconds >= 10.0 else f"{seconds:.1f} s"


def cut(text: str, most: int = MOST_TEXT) -> str:
    """The beginning of a text that is too long for a sentence, up to the end of a word.

    >>> cut("a reason", 8), cut("a long reason", 8)
    ('a reason', 'a long [...]')
    """
    return text if len(text) <= most else f"{text[: most + 1].rpartition(' ')[0] or text[:most]} [...]"


def brief(text: str) -> str:
    """What an error says has happened, without what is to be done about it, for a sentence."""
    for advice in ADVICE:
        text = text.replace(f"; {advice}", "")
    return cut(text)


def messages_text(count: int) -> str:
    """How many messages wait, as people say it.

    >>> messages_text(1), messages_text(7)
    ('1 message waits', '7 messages wait')
    """
    return "1 message waits" if count == 1 else f"{count} messages wait"


class Told(msgspec.Struct, frozen=True):
    """What an actor itself has said a moment ago.

    Attributes:
        status: how it is; None if nobody lives there, or it does not say.
        queued_before: how many messages waited a moment before; None: nobody has looked.
        overview: of a supervisor, its state.
        silence: that nothing was said.
        above: the state of its supervisor, if that lives in another process.
        below: how those below it are that live in other processes, by address.
    """

    status: Status | None = None
    queued_before: int | None = None
    overview: dict[str, Any] = {}
    silence: Silence | None = None
    above: dict[str, Any] = {}
    below: dict[str, Status] = {}


def collect(
    node: Node, recorder: HistoryRecorder, address: str, told: Told, quarantined: list[QuarantinedMessage]
) -> Evidence:
    """All that is known about an address now."""
    cell = node.find(address)
    above = address.rpartition("/")[0]
    ancestors: list[PastEvent] = []
    while above:
        ancestors += answer(recorder, question(literal(above), kinds=GAVE_UP_KINDS, limit=5)).events
        above = above.rpartition("/")[0]
    children = _children(node, address, told)
    return Evidence(
        address,
        node.clock.wall(),
        cell is not None and cell.state is not GONE,
        recorder.lives.at(address),
        answer(recorder, question(literal(address), limit=MOST)).events,
        sorted(ancestors, key=lambda event: event.number),
        answer(recorder, question(kinds=STORE_KINDS, limit=20)).events,
        told.status,
        told.queued_before,
        # All mailboxes are searched for them, and only of a turn that goes on is anything said of its asks.
        outstanding(node, address) if told.status is not None and told.status.turn is not None else [],
        None if cell is None else _allowance(cell) or _own_allowance(told.above),
        [put_aside(one) for one in quarantined],
        recorder.is_in_storm,
        Below(
            _not_over(
                recorder, answer(recorder, question(f"{literal(address)}/*", kinds=CHILD_KINDS, limit=MOST)).events
            ),
            children,
            _ended_below(recorder, address, children),
        ),
        Below(
            _deeper(recorder, address),
            [] if cell is None else _deeper_now(cell, told.below),
            _deeper_ended(node, recorder, address),
        ),
        _own_allowance(told.overview),
        None if cell is None else protection_of(cell),
        OwnProcess(None if cell is None else _memory(cell), told.silence),
        None if cell is None else _waiting(cell),
        _awaited(node, address),
    )


def _awaited(node: Node, address: str) -> str:
    """The address for which the start of a child waits, as far as its supervisor lives in this process."""
    above, _, name = address.rpartition("/")
    supervisor = node.find(above)
    one = None if supervisor is None else (listed_at(supervisor) or {}).get(name)
    return "" if one is None else one.awaited


def _children(node: Node, address: str, told: Told) -> list[ChildNow]:
    """A supervisor's children, each with its turn if that can be seen from here, or its process has said so."""
    return [
        _child_now(node.find(path := f"{address}/{name}"), name, about, told.below.get(path))
        for name, about in told.overview.get("children", {}).items()
    ]


def _child_now(cell: Cell | None, name: str, about: dict[str, Any], told: Status | None) -> ChildNow:
    state, awaited = str(about["state"]), str(about.get("awaited", ""))
    if cell is None or cell.is_dead:
        return ChildNow(name, state, awaited=awaited)
    status = told or status_of(cell)
    state = status.state if (state, status.state) == ("running", "suspended") else state
    return _now(cell, status, name, state, awaited)


def _now(cell: Cell, status: Status, name: str, state: str, awaited: str = "") -> ChildNow:
    found = list(_queued(cell, FIRST)) if status.queued else []
    waited = max((one.seconds for one in found), default=0.0)
    is_asked = any(one.is_ask and one.seconds >= LONG_TURN for one in found)
    rests = "" if is_asked else status.turn_rests
    turn, seconds, at = status.turn or "", status.turn_seconds, status.turn_at
    return ChildNow(name, state, turn, seconds, at, awaited, status.queued, waited, rests)


def _ended_below(recorder: HistoryRecorder, address: str, children: list[ChildNow]) -> dict[str, PastLife]:
    """The last lives of those that lived directly below, and do not now; unless they ended with the whole system."""
    there = {f"{address}/{one.name}" for one in children if one.state != STOPPED}
    return {
        path: life
        for path, life in recorder.lives.last_below(address)
        if life.is_over and path not in there and life.reason_kind not in WITH_THE_ROOT
    }


def _deeper(recorder: HistoryRecorder, address: str) -> list[PastEvent]:
    """What weighs much of that which happened further below."""
    events = answer(recorder, question(f"{literal(address)}/*/*/**", kinds=DEEPER_KINDS, limit=MOST)).events
    return _not_over(recorder, [event for event in events if not is_part(event.address, address)])


def _not_over(recorder: HistoryRecorder, events: list[PastEvent]) -> list[PastEvent]:
    """The events, without those that a life behind them has made good, and the starts of former programs."""
    begun = answer(recorder, question(kinds=("SystemStarted",), limit=1)).events
    since = begun[-1].number if begun else 0
    return [
        event
        for event in events
        if not (event.kind in MADE_GOOD and _is_over(recorder, event))
        and not (event.kind in START_KINDS and event.number < since)
    ]


def _is_over(recorder: HistoryRecorder, event: PastEvent) -> bool:
    """Whether a life has begun at the address since, and has not ended by a fault."""
    lives = recorder.lives.at(event.address)
    return bool(lives) and (lives[-1].started or 0.0) > event.at and not is_fault(lives[-1])


def _deeper_now(cell: Cell, told: dict[str, Status]) -> list[ChildNow]:
    """Who does not get on further below."""
    found: list[ChildNow] = []
    for one in below(cell):
        if one.is_dead or not is_deeper(one.path, cell.path):
            continue
        status = told.get(one.path) or status_of(one)
        now = _now(one, status, one.path, status.state)
        if now.state == "suspended" or now.is_long:
            found.append(now)
    return found


def below(cell: Cell) -> Iterator[Cell]:
    """Who is below somebody, as far as this process knows, the nearest first; without parts of protected actors."""
    level = deque(_below(cell))
    for _ in range(MOST_DEEPER):
        if not level:
            break
        one = level.popleft()
        level += _below(one)
        yield one


def _below(cell: Cell) -> list[Cell]:
    """Who is directly below somebody, without the parts of a protected actor."""
    return [one for name, one in list((cell.children or {}).items()) if name != PARTS]


def _deeper_ended(node: Node, recorder: HistoryRecorder, address: str) -> dict[str, PastLife]:
    """Who ended further below by a fault, and is not there."""
    return {
        path: life
        for path, life in recorder.lives.last_deeper(address)
        if life.is_over
        and is_fault(life)
        and not is_part(path, address)
        and ((cell := node.find(path)) is None or cell.is_dead)
    }


def _own_allowance(overview: dict[str, Any]) -> Allowance | None:
    if "intensity" not in overview:
        return None
    return Allowance(overview["intensity"], overview["period"], overview["restarts"])


def silence_of(pid: int, seconds: float) -> Silence:
    """What is to be said of a process that has not answered for so long."""
    import psutil  # only now: a system that runs no process does without it

    try:
        return Silence(pid, seconds, psutil.Process(pid).status() == psutil.STATUS_STOPPED)
    except psutil.Error:
        return Silence(pid, seconds, is_stopped=False)  # It has ended meanwhile.


def _memory(cell: Cell) -> ProcessMemory | None:
    """The memory of the actor's own process; None if it has none, or nothing bounds it."""
    limits = cell.spec.limits if isinstance(cell.spec, ChildSpec) else None
    process = cell.host.place.process(cell)
    if process is None or limits is None or limits.memory_bytes is None:
        return None
    import psutil  # only now: a system that runs no process does without it

    try:
        return ProcessMemory(psutil.Process(process.pid).memory_info().rss, limits.memory_bytes)
    except psutil.Error:
        return None  # It has ended meanwhile.


def _waiting(cell: Cell) -> Waiting | None:
    """What waits for an actor, as far as that is known in this process."""
    found = list(_queued(cell, MOST_LOOKED_AT))
    counts = Counter(one.message for one in found)
    senders = {one.message: one.sender for one in found if one.sender}
    for name, count in counts.most_common(1):
        longest = max(one.seconds for one in found)
        late = sum(one.is_late for one in found)
        asked = max((one.seconds for one in found if one.is_ask), default=0.0)
        return Waiting(name, count, senders.get(name, ""), longest, late, _mean_turn(cell), asked)
    return None


class _Queued(NamedTuple):
    """A message that waits: its type, its sender or "", for how long (0 if unknown), and whether an ask gave it up."""

    message: str
    sender: str
    seconds: float
    is_late: bool
    is_ask: bool


def _queued(cell: Cell, most: int) -> Iterator[_Queued]:
    """What waits at an actor, oldest first: a home knows when it was admitted, a mailbox when an ask was made."""
    switch, node = switch_of(cell), cell.node
    if switch is None:
        for item in items_at(cell, most):
            sender = item.sender.path if isinstance(item, Item) and item.sender is not None else ""
            is_late = isinstance(item, Ask) and item.is_done
            seconds = _waited(item, node.loop.time())
            yield _Queued(message_type(message_in(item)), sender, seconds, is_late, isinstance(item, Ask))
        return
    in_hand = switch.in_hand(cell.host.place.running(cell))
    for source in islice(switch.ledger.open.values(), most):
        if source.kind == MESSAGE and source.id != in_hand and not source.was_stashed:
            seconds = max(0.0, node.clock.wall() - source.time)
            is_ask = source.ask is not None
            is_late = source.ask is not None and source.ask.is_done
            yield _Queued(source.name.replace(":", "."), source.sender or "", seconds, is_late, is_ask)


def _waited(item: Any, now: float) -> float:
    """For how long an ask has waited; once its time is over, only that is known: it was at least its timeout."""
    if not isinstance(item, Ask):
        return 0.0
    if item.deadline == NO_DEADLINE:
        return item.timeout if item.is_done else 0.0
    return max(0.0, now - (item.deadline - item.timeout))


def _mean_turn(cell: Cell) -> float:
    """How long a turn takes in the mean, in seconds, if that is counted in this process."""
    tap = cell.more.tap if cell.more is not None else None
    if tap is None or not tap.counting or not cell.host.place.is_here:
        return 0.0
    counts = tap.counts()
    return counts.turn_seconds / counts.turns if counts.turns else 0.0


def put_aside(one: QuarantinedMessage, *, payloads: bool = False) -> PutAside:
    """A message in quarantine as plain data; what is in it only with `payloads`."""
    name = one.kind if one.message is None else message_type(one.message)
    payload = shortened(content(one.message)) if payloads and one.message is not None else ""
    return PutAside(one.address, name, one.attempts, one.since, one.sender or "", one.id, payload)


def outstanding(node: Node, address: str) -> list[Outstanding]:
    """The asks of an actor that have no answer yet, the oldest first."""
    now = node.loop.time()
    found = [
        Outstanding(to.path, message_type(message_in(ask)), max(0.0, now - (ask.deadline - ask.timeout)))
        for to, ask in open_asks(node, MOST_LOOKED_AT)
        if ask.sender is not None and ask.sender.path == address
    ]
    return sorted(found, key=lambda one: -one.seconds)


def _allowance(cell: Cell) -> Allowance | None:
    above = cell.parent.actor if cell.parent is not None else None
    if cell.spec is None or not isinstance(above, Supervisor) or "_flags" not in above.__dict__:
        return None
    flags = above._flags
    restarts = recent_restarts(above._restarts, cell.node.loop.time(), flags.period)
    return Allowance(flags.intensity, flags.period, len(restarts))
