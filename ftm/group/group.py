"""What is known of a group of replicas, outside of all actors: each of them may die at any moment.

The proxy, the detector and the failover manager act on this; the next life of each goes on where the last one was.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import msgspec

from ...actors.kernel.cell import Cell
from ...actors.kernel.message import Message
from ...checkpoint.inputs import EXPIRED, Batch
from ...checkpoint.protocol import (
    DROPPED,
    FAILED,
    START,
    STASHED,
    Closed,
    Feed,
    Go,
    Live,
    Outcome,
    PipeDone,
    Released,
    Snapshot,
    SnapshotNow,
    ToLife,
    TurnEnd,
)  # fmt: skip
from ...checkpoint.snapshot.snapshot_record import Meta, meta_now, put
from ..bricks.background_work import Background
from ..bricks.brick_messages import MOST_REQUESTS, Done, Ended, Inward, Outward, Request, Strayed, Work, WorkLost
from .behind import Behind
from .diverged import Strays
from .hold import Hold
from .hung import Stuck
from .membership import Look as Look
from .membership import Members
from .transient_homes import forget_ended, is_unkept

if TYPE_CHECKING:
    from ...checkpoint.home.switch import Switch
    from ..model.detection import Detection
    from .reconfiguration import Reconfiguration

MOST_BYTES = 1_000_000
"""Of one batch."""
KEPT_TURNS = 256
"""Ended turns after which those of an actor that keeps none are forgotten."""


class Flush(Message):
    """There is something to send."""


class Group(Members):
    """A protected address: its replicas, who of them leads, and what is on its way to it."""

    begins = False  # What the proxy has not sent to any replica is not begun.

    def __init__(
        self, cell: Cell, switch: Switch, names: tuple[str, ...], *, epoch: int, config: int, detection: Detection
    ) -> None:
        super().__init__(cell, names, epoch, detection)
        self.switch, self.config = switch, config
        self.hold = Hold(self.node, self.path)
        self.strays = Strays(self)
        self.stuck = Stuck(self)
        self.failovers = 0
        self.is_begun = False  # somebody has led
        # What is on its way.
        self.waiting: deque[Feed | Go] = deque()
        self.inward: list[Outcome | SnapshotNow] = []
        self.finished: list[Ended] = []  # parts whose outcomes somebody waits to be at home
        self.ledger: dict[int, Feed] = {}  # what the home has fed and not heard the end of, in that order
        self.careful: set[int] = set()  # inputs in whose company a replica has died: each is sent alone
        self.inside: set[int] = set()  # inputs that a replica had that does not lead any more, not ended since
        self.out: Work | None = None
        self.number = 0
        self.is_again = False  # another leader has not been sent all there is
        self.is_live = self.has_gone = False
        self.copy: Meta | None = None  # the state that home keeps while the mechanism is not trusted
        self.untrusted: set[object] = set()  # those for whose sake it is kept
        self._copying: list[asyncio.Future[None]] = []
        self._pieces: list[bytes] = []
        self.is_held = False  # nothing new goes in: nobody could take over yet
        self.is_suspended = self.is_stopping = False
        self.change: Reconfiguration | None = None  # that is being made
        self.gone_back: Reconfiguration | None = None  # done by a failover: what is left is to tidy up
        self.is_resting = False  # nothing new goes in: the mechanism is about to be changed
        self.joins_early = False  # others join before the first one has handled anything
        self.is_changing = False  # the replicas change it: nobody else may tell them anything
        self.is_joining = False  # a replica is catching up
        self.is_poked = False
        self.stale = self.doubled = 0  # messages of earlier epochs, outcomes that were known
        self.background = Background(self)
        self.behind = Behind()
        self._quiet: list[asyncio.Future[None]] = []
        # Whom to tell.
        self.on_live: Callable[[Live], None] = switch.from_life
        self.on_over: Callable[[str], None] = lambda why: None  # nobody is left who could lead
        self.on_start_failed: Callable[[TurnEnd], None] = lambda end: None
        self.on_ended: Callable[[dict[str, Any]], None] = lambda reason: None
        self.on_joined: Callable[[], None] = lambda: None
        self.back_to: Callable[[], Reconfiguration | None] = lambda: None  # the stack that has to come back
        self.drops: Callable[[TurnEnd], bool] = lambda end: False  # a new stack: what it lets fall is asked for again
        self.went_back: Callable[[Reconfiguration], None] = lambda change: None
        self.on_joining: Callable[[str], None] = lambda name: None

    # -- replicas ---------------------------------------------------------------------------------------------------

    def joined(self, name: str, life: int) -> None:
        """A replica has caught up, and could lead."""
        self.members[name] = life
        self.strays.joined(name, life)
        self.stir()
        self.go_on()
        self.on_joined()

    def is_steady(self) -> bool:
        """Whether one replica leads, and nobody has to be told so, or of a death."""
        primary = self.primary
        is_led = primary is not None and self.leading is None and self.is_well(primary)
        return self.is_live and is_led and not self.condemned and not self.dropped and not self.is_joining

    def go_on(self) -> None:
        """New inputs may go in."""
        self.is_held = False
        self.poke()

    # -- from the home ----------------------------------------------------------------------------------------------

    def to_life(self, record: ToLife) -> None:
        """Stands as the home's way to its life."""
        match record:
            case Feed():
                self.ledger[record.id] = record
                self.waiting.append(record)
            case Go():
                self.waiting.append(record)
            case Outcome() | SnapshotNow():
                self.inward.append(record)
            case _:
                return  # The others are for lives that are no group.
        self.poke()

    def poke(self) -> None:
        """Have the proxy look."""
        if not self.is_poked and not self.is_over:
            self.is_poked = True
            self.tell("proxy", Flush())

    def next_inward(self) -> Inward | None:
        """What goes past the bricks; a snapshot is asked for when the home knows all that a replica does."""
        if not self.inward or self.primary is None:
            return None
        records, self.inward = self.inward, []
        if self.inside:
            self.inward = [one for one in records if isinstance(one, SnapshotNow)]
            records = [one for one in records if one not in self.inward]
        return Inward(self.epoch, records) if records else None

    def next_work(self) -> Work | None:
        """The next batch, if there is something, and none is out. What was inside once is ended in any case.

        Another leader is sent one even if it is empty: what it has to say of the time before waits for that.
        """
        if self._quiet:
            self._ended(set())  # Another one may lead now, and nothing was inside the last one.
        if self.out is not None or self.primary is None:
            return None
        is_open = not (self.has_gone and self.is_held)
        takes_new = not (self.is_suspended or self.is_stopping or self.is_resting)
        requests, go, size = list[Request](), None, 0
        lives: dict[str, int] = {}
        while is_open and self.waiting and len(requests) < MOST_REQUESTS and size < MOST_BYTES:
            first = self.waiting[0]
            if not takes_new and (isinstance(first, Go) or first.id not in self.inside):
                break
            if isinstance(first, Go):
                go = first
                self.has_gone = True
                self.waiting.popleft()
                break
            is_alone = first.id in self.careful
            if is_alone and requests:
                break
            self.waiting.popleft()
            if self.is_live and first.id not in self.switch.open:
                self.ledger.pop(first.id, None)  # The home has dropped it meanwhile.
                self._ended({first.id})
                continue
            requests.append(self._request(first, lives))
            size += len(first.body)
            if is_alone:
                break
        if not requests and go is None and not self.is_again:
            return None
        self.number += 1
        self.out = Work(self.epoch, self.config, self.number, requests, go, bool(self.untrusted))
        if not self.waiting or not requests:
            self.is_again = False
        return self.out

    def _request(self, feed: Feed, lives: dict[str, int]) -> Request:
        client = feed.sender or ""
        if client not in lives:
            cell = self.node.find(client) if client else None
            lives[client] = 0 if cell is None else cell.life
        source = self.switch.open.get(feed.id)
        ask = None if source is None else source.ask
        if ask is not None:
            if not ask.started and not ask.deadline:
                # Its client was told that it has not run: no replica may find, on its own clock, that there is time.
                feed = msgspec.structs.replace(feed, deadline=EXPIRED)
            ask.started = True
        return Request(client, lives[client], feed)

    def send_again(self, *, careful: bool = False) -> None:
        """All that has no end yet goes to whoever leads now: first what had begun to let something out.

        `careful`: a replica has died with a batch inside; if that was the fault of one of its messages, it will be
        seen which one.
        """
        begun = self.switch.ledger.begun if self.switch.ledger.released else -1
        if careful and self.out is not None:
            self.careful = {one.feed.id for one in self.out.requests if one.feed.id in self.ledger}
        left = [feed for feed in self.ledger.values() if not self.is_live or feed.id in self.switch.open]
        self.ledger = {feed.id: feed for feed in left}
        unsent = {one.id for one in self.waiting if isinstance(one, Feed)} - self.inside
        self.inside = self.ledger.keys() - unsent
        left.sort(key=lambda feed: feed.id != begun)
        gone = [one for one in self.waiting if isinstance(one, Go)]
        self.waiting = deque(left)
        if self.out is not None and self.out.go is not None and not self.is_live:
            gone = [self.out.go]
        self.waiting.extend(gone)
        if begun >= 0 and left and left[0].id == begun:
            self.waiting[0] = self.ledger[begun] = without_deadline(left[0])
        self.out, self.is_again = None, True
        self.poke()

    def least_turn(self) -> int:
        """The turn after which another one that leads goes on, if turns that are lost do not come again; else -1."""
        return -1 if self.switch.method.replays else self.switch.turn

    def forget_answers(self) -> None:
        """Another one is to lead: what it asks again is answered again."""
        self.inward.clear()
        self.finished.clear()
        self._pieces.clear()
        self.switch.timers.claimed.clear()  # Its hooks want theirs again.
        self.switch.arrival.cancel()  # The last one may have died in the middle of a snapshot,
        self.switch.due.restarted()  # or before it began with it.
        if self.switch.due.wishes:
            self.switch.due.on_want(self.switch)

    def only_suspect_input(self) -> int:
        """The input in whose turn a replica must have died, if only one was inside; else -1."""
        out = self.out
        if out is None or len(out.requests) != 1 or out.requests[0].feed.id not in self.ledger:
            return -1
        return out.requests[0].feed.id

    # -- to the home ------------------------------------------------------------------------------------------------

    def take_done(self, done: Done) -> None:
        """Outcomes, in turn order; those of an earlier epoch count for nothing."""
        if not self._is_of_now(done.epoch):
            return
        for end in done.ends:
            self._end(end)
        if self.is_over:
            return
        self.behind.put(done.behind, done.more)
        if not self._take_beside(self.switch.turn if self.is_live else None):
            return
        if done.live is not None and not self.is_live:
            self.is_live = True
            self.on_live(done.live)
        out = self.out
        if done.is_last and out is not None and out.number == done.number:
            self.out = None
            if out.copy:
                copying, self._copying = self._copying, []
                for future in copying:
                    if not future.done():
                        future.set_result(None)
            ended = {one.feed.id for one in out.requests}
            self.careful -= ended
            self._ended(ended)
            self._forget_turns()
        # With nothing in hand any more, turns that have not come until now do not come at all.
        if self.out is None and not self.inside and not self._take_beside(None):
            return
        if done.wait:
            self.finished.append(Ended(self.epoch, done.part))

    def _take_beside(self, turn: int | None) -> bool:
        """What stands behind turns up to this one (None: any). False: the life is over by that."""
        for record in self.behind.due(turn):
            if isinstance(record, Closed):
                self.on_ended(record.reason)
            elif isinstance(record, Strayed):
                self.strays.told(record.path)
            elif isinstance(record, Snapshot) and not self.switch.method.snapshots:
                self.take_copy([record])
            elif isinstance(record, WorkLost):
                if self.background.is_lost(record.turn):
                    self._give_up("a turn has failed with background work (pipe_to_self) out")
                    return False
            elif not isinstance(record, PipeDone) or self.background.back(record):
                self.switch.from_life(record)
        return True

    def take_copy(self, records: list[Snapshot]) -> None:
        """The state of an actor that is not recorded, with what has led to it."""
        for record in records:
            self._pieces.append(record.data)
            if record.is_last:
                state, self._pieces = b"".join(self._pieces), []
                meta = meta_now(self.switch, record.turn, record.stash, state)
                self.copy = msgspec.structs.replace(meta, traps=record.traps)
                put(self.switch, self.copy, 1)

    def keep_copy(self, sake: object) -> asyncio.Future[None]:
        """For the sake of something that is not trusted, home has a copy of a state that it would not keep otherwise.

        Returns:
            What ends when it has one, or cannot have it, as of a moment from now on.
        """
        future: asyncio.Future[None] = self.node.loop.create_future()
        if is_unkept(self.switch.method):
            self.untrusted.add(sake)
            self._copying.append(future)
            self.is_again = True  # It comes behind a batch, which may be empty.
            self.poke()
        else:
            future.set_result(None)
        return future

    def quiet(self) -> asyncio.Future[None]:
        """A future that ends when nothing is inside any more; somebody has seen to it that nothing new goes in."""
        future: asyncio.Future[None] = self.node.loop.create_future()
        self._quiet.append(future)
        self._ended(set())
        return future

    def _ended(self, ids: set[int]) -> None:
        """These have; whoever waits for that hears when there are no others inside."""
        if self.inside:
            self.inside -= ids
            if not self.inside:
                self.poke()  # What was held back meanwhile.
        if self.inside or self.out is not None or self.primary is None:
            return
        waiting, self._quiet = self._quiet, []
        for future in waiting:
            if not future.done():
                future.set_result(None)

    def take_outward(self, outward: Outward) -> None:
        """What left in the middle of a turn, or beside it."""
        if self._is_of_now(outward.epoch):
            for record in outward.records:
                if isinstance(record, Released) and not self._is_front(record):
                    self._is_behind(record.turn)
                    return
                if isinstance(record, Released):
                    self.background.note(record.turn, record.outs)
                self.switch.from_life(record)

    def _is_front(self, record: Released) -> bool:
        """Whether it is of the turn that comes next, or of one that is known."""
        return not self.is_live or record.turn > self.switch.turn or self._is_known(record.turn, record.id)

    def _is_known(self, turn: int, number: int) -> bool:
        """Whether this input was handled in this turn, as far as the home knows it."""
        past = self.switch.turns.get(turn)
        return past.input.id == number if past is not None else number in self.switch.ledger.stashed()

    def _is_behind(self, turn: int) -> None:
        """Whoever leads has handled something in a turn in which the home knows something else to be handled.

        It must never count: from the snapshot and the journal the life is as it was.
        """
        self._give_up(f"{self.primary} has not got the state that was acknowledged at turn {turn}")

    def _give_up(self, why: str) -> None:
        """The life is over; another one begins as its home has it."""
        self.out = None  # It is nobody's fault that is inside.
        self.is_over, self.why = True, why
        self.on_over(why)

    def _is_of_now(self, epoch: int) -> bool:
        if epoch == self.epoch and not self.is_over and (self.primary or self.leading) is not None:
            return True  # Who is to lead may say something before it says that it does.
        self.stale += 1
        return False

    def _end(self, end: TurnEnd) -> None:
        switch = self.switch
        if end.turn < 0 and end.status == DROPPED and end.id in switch.open and self.drops(end):
            return  # It is asked of the stack before.
        if end.turn < 0 and end.status == DROPPED:  # It was handled, and nobody knows any more what came of it.
            self.ledger.pop(end.id, None)
            if end.id in switch.open:
                batch = Batch()
                switch.end_without_turn(switch.open[end.id], end.answer, batch)
                batch.commit(switch.journal)
            return
        if self.is_live and (end.turn <= switch.turn or end.id not in switch.open):
            self.doubled += 1
            if end.id not in switch.open:
                self.ledger.pop(end.id, None)
            elif not self._is_known(end.turn, end.id):
                self._is_behind(end.turn)
            return
        source = switch.open.get(end.id)
        if source is not None and source.kind == START and end.status == FAILED:
            self.on_start_failed(end)
            return
        if self.stuck.takes(end):
            self.ledger.pop(end.id, None)
            return
        if end.outs:
            self.background.note(end.turn, end.outs)
        switch.from_life(end)
        if end.status != STASHED:
            self.ledger.pop(end.id, None)

    def _forget_turns(self) -> None:
        """An actor that is not recorded keeps nothing of what it has handled."""
        switch = self.switch
        if switch.method.replays or switch.method.snapshots or len(switch.turns) < KEPT_TURNS:
            return
        forget_ended(switch)


def without_deadline(feed: Feed) -> Feed:
    """What has begun is finished, whatever its deadline."""
    return Feed(
        feed.id, feed.turn, feed.kind, feed.name, feed.body, feed.time, feed.sender,
        feed.is_ask, feed.chain, feed.pipes, 0.0, feed.origin,
    )  # fmt: skip
