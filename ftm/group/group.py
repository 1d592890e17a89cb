"""The shared knowledge about one group of replicas; it is outside of all actors, which may die at any moment.

The proxy, the detector and the failover manager act on this; the next life of each goes on where the last one was. What
is known is data (`membership.py`, `delivery.py`, `reconfiguration.py`); here is what goes to the home and comes from
there.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Protocol

import msgspec

from ...actors.kernel.cell import Cell
from ...actors.kernel.message import Message
from ...checkpoint.inputs import EXPIRED, Batch
from ...checkpoint.protocol import FAILED, START, STASHED, Closed, Feed, Live, PipeDone, Released, Snapshot
from ..bricks.background_work import Background
from ..bricks.behind import Behind
from ..bricks.brick_messages import Done, Inward, Outward, PartEnded, PutBack, Request, Strayed, Work, WorkLost
from ..events import BackgroundWorkLost, ReplicaFaulty
from .delivery import Delivery
from .hung import Stuck
from .membership import LookAgain, Membership, Strays
from .reconfiguration import Adaptation
from .replicas import Replicas, finish
from .transient_homes import StateCopies, forget_ended

if TYPE_CHECKING:
    from ...checkpoint.home.switch import Switch
    from ...checkpoint.inputs import Input
    from ...checkpoint.protocol import ToLife, TurnEnd
    from .group_place import GroupPlace

KEPT_TURNS = 256
"""Ended turns after which those of an actor that keeps none are forgotten."""


class SendNext(Message):
    """There is something to send."""


class LifeOwner(Protocol):
    """Whose life it is that a group lives: the address, or a move on its way there or from there."""

    def life_is_up(self, group: Group, live: Live) -> None:
        """The life has caught up."""

    def has_fallen(self, group: Group, why: str) -> None:
        """No replica is left that could lead."""


class Group:
    """A protected address: its replicas, who of them leads, and what is on its way to it."""

    begins = False  # What the proxy has not sent to any replica is not begun.
    is_far = True

    def __init__(self, cell: Cell, switch: Switch, place: GroupPlace, known: Membership) -> None:
        self.switch, self.place = switch, place
        self.owner: LifeOwner = place
        self.membership, self.delivery, self.adaptation = known, Delivery(), Adaptation(place.config)
        self.replicas = Replicas(cell, known, place.detection, lambda name, why: place.at_fault(self, name, why))
        self.strays, self.behind = Strays(), Behind()
        self.stuck = Stuck(self.replicas, switch)
        self.background = Background(switch, self._is_work_lost)
        self.copies = StateCopies(switch)
        self.failovers = 0
        self.joins_early = False  # others join before the first one has handled anything
        self._is_poked = False
        self._quiet: list[asyncio.Future[None]] = []

    def hand_to(self, owner: LifeOwner) -> None:
        """What happens to the group happens to the life of this owner from now on."""
        self.owner = owner

    # -- replicas ---------------------------------------------------------------------------------------------------

    def joined(self, name: str, life: int) -> None:
        """A replica has caught up, and could lead."""
        self.membership.members[name] = life
        self.strays.joined(name, life, self.switch.turn)
        self.replicas.stir()
        self.go_on()

    def is_steady(self) -> bool:
        """Whether one replica leads, and nobody has to be told so, or of a death."""
        return self.delivery.is_live and self.membership.is_led(self.replicas.lives())

    def is_being_changed(self) -> bool:
        """Whether replicas that are at rest are about to change their mechanism, or one that has failed has to go."""
        adaptation = self.adaptation
        is_back = adaptation.change is not None and adaptation.change.is_back
        return self.delivery.is_resting or adaptation.is_changing or is_back

    def go_on(self) -> None:
        """New inputs may go in."""
        self.delivery.is_held = False
        self.poke()

    def fall(self, why: str) -> None:
        """No replica leads, or will: the life is over."""
        self.membership.is_over, self.membership.why = True, why
        self.replicas.stir()
        self.owner.has_fallen(self, why)

    def stir_engine(self) -> None:
        """Have a change go on, or end, that waits for something."""
        self.replicas.stir()
        self.replicas.tell("adapt", LookAgain())

    def close(self, why: str) -> None:
        """The life has ended, or is elsewhere: nothing of the group is waited for any more."""
        self.membership.is_over = True
        self.replicas.hold.give_back()
        if self.adaptation.change is not None:
            self.adaptation.change.close(why)

    def _has_strayed(self, path: str) -> None:
        """The leader says that the one at this path has lost its state."""
        known, replicas, name = self.membership, self.replicas, path.rpartition("/")[2]
        life = known.members.get(name, 0) or known.joining.get(name, 0)
        if not life:
            return  # It does not count as it is; or that life is over, and the next one has to join anyway.
        times, is_faulty = self.strays.count_again(name, life, self.switch.turn, replicas.node.loop.time())
        if is_faulty:
            known.condemned[name] = life
            replicas.node.emit(ReplicaFaulty(replicas.path, name, known.epoch, times))
        replicas.lost(name, "it has diverged from the one that leads")
        replicas.wake()

    # -- from the home ----------------------------------------------------------------------------------------------

    def take(self, source: Input) -> None:
        """Hand a new input to whoever lives the life."""
        self.to_life(source.feed())

    def to_life(self, record: ToLife) -> None:
        """Stands as the home's way to its life."""
        if self.delivery.put(record):
            self.poke()

    def poke(self) -> None:
        """Have the proxy send what there is."""
        if not self._is_poked and not self.membership.is_over:
            self._is_poked = True
            self.replicas.tell("proxy", SendNext())

    def next_messages(self) -> Iterable[Message[Any]]:
        """Take what goes to whoever leads now."""
        self._is_poked = False
        known, delivery = self.membership, self.delivery
        if known.primary is not None and (records := delivery.next_inward()):
            yield Inward(known.epoch, records)
        finished, delivery.finished = delivery.finished, []
        yield from finished
        if (work := self._next_work()) is not None:
            yield work

    def _next_work(self) -> Work | None:
        """Take the next batch, if there is something, and none is out."""
        delivery, had_inside = self.delivery, bool(self.delivery.inside)
        self._settle(had_inside)  # Another one may lead now, and nothing was inside the last one.
        if self.membership.primary is None:
            return None
        taken = delivery.next_batch(self.switch.open)
        if taken is None:
            self._settle(had_inside)
            return None
        lives: dict[str, int] = {}
        requests = [self._request(feed, lives) for feed in taken[0]]
        config, copies = self.adaptation.config, bool(self.copies.untrusted)
        delivery.out = Work(self.membership.epoch, config, delivery.number, requests, taken[1], copies)
        self._settle(had_inside)
        return delivery.out

    def _request(self, feed: Feed, lives: dict[str, int]) -> Request:
        client = feed.sender or ""
        if client not in lives:
            cell = self.replicas.node.find(client) if client else None
            lives[client] = 0 if cell is None else cell.life
        source = self.switch.open.get(feed.id)
        ask = None if source is None else source.ask
        if ask is not None:
            if ask.started is not True and not ask.deadline:
                # Its client was told that it has not run: no replica may find, on its own clock, that there is time.
                feed = msgspec.structs.replace(feed, deadline=EXPIRED)
            ask.started = True
        return Request(client, lives[client], feed)

    def send_again(self, *, careful: bool = False) -> None:
        """All that has no end yet goes to whoever leads now; `careful`: a replica has died with a batch inside."""
        ledger = self.switch.ledger
        self.delivery.send_again(self.switch.open, ledger.begun if ledger.released else -1, careful=careful)
        self.poke()

    def withdraw(self) -> None:
        """The replicas have given back what was inside, a turn that rests: it is run again when something may go in."""
        switch = self.switch
        switch.calls.rests.abandon()
        self.delivery.withdraw(switch.open, switch.ledger.begun if switch.ledger.released else -1)
        self._settle(True)

    def forget_answers(self) -> None:
        """Another one is to lead: what it asks again is answered again, and its effects have a token of their own."""
        self.switch.life.token = self.replicas.node.numbers.next_token()
        self.delivery.inward.clear()
        self.delivery.finished.clear()
        self.copies.restart()
        self.switch.timers.claimed.clear()  # Its hooks want theirs again.
        self.switch.arrival.cancel()  # The last one may have died in the middle of a snapshot,
        self.switch.due.restarted()  # or before it began with it.
        if self.switch.due.wishes:
            self.switch.due.on_want(self.switch)

    # -- to the home ------------------------------------------------------------------------------------------------

    def take_done(self, done: Done) -> None:
        """Outcomes, in turn order; those of an earlier epoch count for nothing."""
        known, delivery = self.membership, self.delivery
        if not self._is_of_now(done.epoch):
            return
        for end in done.ends:
            self._end(end)
        if known.is_over:
            return
        self.behind.put(done.behind, done.more)
        if not self._take_beside(self.switch.turn if delivery.is_live else None):
            return
        if done.live is not None and not delivery.is_live:
            delivery.come_up()
            self.owner.life_is_up(self, done.live)
        had_inside = bool(delivery.inside)
        if done.is_last and (out := delivery.end_batch(done.number)) is not None:
            if out.copy:
                self.copies.have_come()
            self._settle(had_inside)
            self._forget_turns()
        # With nothing in hand any more, turns that have not come until now do not come at all.
        if delivery.is_quiet and not self._take_beside(None):
            return
        if done.wait:
            delivery.finished.append(PartEnded(known.epoch, done.part))

    def _take_beside(self, turn: int | None) -> bool:
        """What stands behind turns up to this one (None: any). False: the life is over by that."""
        for record in self.behind.due(turn):
            if isinstance(record, Closed):
                self.place.has_ended_itself(self, record.reason)
            elif isinstance(record, Strayed):
                self._has_strayed(record.path)
            elif isinstance(record, PutBack):
                self._ask_again()
            elif isinstance(record, Snapshot) and not self.switch.method.snapshots:
                self.copies.take(record)
            elif isinstance(record, WorkLost):
                if self.background.is_lost(record.turn):
                    self._give_up("a turn has failed with background work (pipe_to_self) out")
                    return False
            elif not isinstance(record, PipeDone) or self.background.back(record):
                self.switch.from_life(record)
        return True

    def _is_work_lost(self, count: int) -> None:
        self.replicas.node.emit(BackgroundWorkLost(self.replicas.path, self.membership.epoch, count))

    def keep_copy(self, sake: object) -> asyncio.Future[None]:
        """For the sake of something that is not trusted, home has a copy of a state that it would not keep otherwise.

        Returns:
            What ends when it has one, or cannot have it, as of a moment from now on.
        """
        future = self.copies.keep(sake)
        if not future.done():
            self._ask_again()
        return future

    def _ask_again(self) -> None:
        """What is wanted comes with, or behind, a batch, which may be empty."""
        self.delivery.is_again = True
        self.poke()

    def quiet(self) -> asyncio.Future[None]:
        """A future that ends when nothing is inside any more; somebody has seen to it that nothing new goes in."""
        future: asyncio.Future[None] = self.replicas.node.loop.create_future()
        self._quiet.append(future)
        self._settle(False)
        return future

    def _settle(self, had_inside: bool) -> None:
        """Something has ended; whoever waits for that hears when nothing else is inside."""
        if had_inside and not self.delivery.inside:
            self.poke()  # What was held back meanwhile.
        if self.delivery.is_quiet and self.membership.primary is not None:
            waiting, self._quiet = self._quiet, []
            finish(waiting)

    def take_outward(self, outward: Outward) -> None:
        """What left in the middle of a turn, or beside it."""
        if self._is_of_now(outward.epoch):
            for record in outward.records:
                if isinstance(record, Released):
                    is_next = not self.delivery.is_live or record.turn > self.switch.turn
                    if not is_next and not self._is_known(record.turn, record.id):
                        self._is_behind(record.turn)
                        return
                    self.background.note(record.turn, record.outs)
                self.switch.from_life(record)

    def _is_known(self, turn: int, number: int) -> bool:
        """Whether this input was handled in this turn, as far as the home knows it."""
        past = self.switch.turns.get(turn)
        return past.input.id == number if past is not None else number in self.switch.ledger.stashed()

    def _is_behind(self, turn: int) -> None:
        """Whoever leads has handled something in a turn in which the home knows something else to be handled.

        It must never count: from the snapshot and the journal the life is as it was.
        """
        self._give_up(f"{self.membership.primary} has not got the state that was acknowledged at turn {turn}")

    def _give_up(self, why: str) -> None:
        """The life is over; another one begins as its home has it."""
        self.delivery.out = None  # It is nobody's fault that is inside.
        self.fall(why)

    def _is_of_now(self, epoch: int) -> bool:
        known = self.membership
        if epoch == known.epoch and not known.is_over and (known.primary or known.leading) is not None:
            return True  # Who is to lead may say something before it says that it does.
        self.delivery.stale += 1
        return False

    def _end(self, end: TurnEnd) -> None:
        switch, delivery, is_open = self.switch, self.delivery, end.id in self.switch.open
        match delivery.judge(end, switch.turn, is_open=is_open, is_known=self._is_known):
            case "dropped":  # If it is asked of the stack before, it has not ended.
                if not (is_open and self.place.drops(end)):
                    delivery.fed.pop(end.id, None)
                    if is_open:  # It was handled, and nobody knows any more what came of it.
                        batch = Batch()
                        switch.end_without_turn(switch.open[end.id], end.answer, batch)
                        batch.commit(switch.journal)
            case "double":
                delivery.doubled += 1
                if not is_open:
                    delivery.fed.pop(end.id, None)
            case "behind":
                delivery.doubled += 1
                self._is_behind(end.turn)
            case "new":
                self._end_turn(end)

    def _end_turn(self, end: TurnEnd) -> None:
        source = self.switch.open.get(end.id)
        if source is not None and source.kind == START and end.status == FAILED:
            self.place.start_failed(self, end)
        elif self.stuck.takes(end):
            self.delivery.fed.pop(end.id, None)
        else:
            if end.outs:
                self.background.note(end.turn, end.outs)
            self.switch.from_life(end)
            if end.status != STASHED:
                self.delivery.fed.pop(end.id, None)

    def _forget_turns(self) -> None:
        """An actor that is not recorded keeps nothing of what it has handled."""
        method = self.switch.method
        if not (method.replays or method.snapshots) and len(self.switch.turns) >= KEPT_TURNS:
            forget_ended(self.switch)
