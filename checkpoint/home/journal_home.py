"""The home of a recorded actor, as the host of its address has it: it keeps, feeds, holds and answers, life after life.

A recovery goes through its phases here (detect, isolate, restart, restore, replay, release), wherever the new life is
lived; each phase is timed and told.
"""

from __future__ import annotations

import asyncio
import functools
import time
from collections.abc import Awaitable, Callable, Iterable
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from ...actors.errors import HoldfastError, StartFailed, StartIgnored
from ...actors.events import ActorStarted, Recovered, RecoveryFailed
from ...actors.exit_reasons import ExitReason, Hung, crash
from ...actors.kernel import links
from ...actors.kernel.address_host import Work
from ...actors.kernel.cell import RUNNING, Cell, TurnRest
from ...actors.kernel.lifecycle import MAILBOX
from ...actors.persistence import UNFIT, is_in_vain
from ..method import Method
from ..recovery.recoveries import Recovery
from ..snapshot.unreplayed import forget_turns
from ..turn_word import input_of, is_innocent, may_have_begun
from .admission import withdraw
from .disposal import drop_all
from .held_messages import (
    MAY_LIVE_AGAIN,
    admit_unread,
    end_wait,
    hold,
    inlet,
    is_unread,
    let_go,
    wait_for_next_life,
)
from .homes import ENDED, Homes
from .life_ports import RemoteLife, own_records
from .present_life import LifePort
from .recorded_home import RecordedHome
from .switch import Switch

if TYPE_CHECKING:
    from ...actors.kernel.actor import Actor
    from ...actors.kernel.address_host import Capacity, Parent
    from ...actors.kernel.envelope import Ask, Item
    from ...actors.process.worker_pool import Worker
    from ..inputs import Input


class RecoveryClock:
    """The phases of one recovery. (Clocks of loops are too coarse for this.)"""

    __slots__ = ("_marks",)

    def __init__(self) -> None:
        self._marks: dict[str, float] = {}

    def mark(self, phase: str, when: float | None = None) -> None:
        """This phase is over now."""
        self._marks[phase] = time.monotonic() if when is None else when

    def when(self, phase: str) -> float:
        """The end of a phase."""
        return self._marks[phase]

    def phases(self, restore_seconds: float) -> dict[str, float]:
        """How many seconds each phase took."""
        spans: dict[str, float] = {}
        before = self._marks.get("noticed")
        for phase in ("detect", "isolate", "restart", "replay", "release"):
            after = self._marks.get(phase)
            if after is None:
                continue
            spans[phase] = max(0.0, after - before) if before is not None else 0.0
            before = after
        spans["restart"] = max(0.0, spans.get("restart", 0.0) - restore_seconds)
        spans["restore"] = restore_seconds
        return spans


class Entered(NamedTuple):
    """A life is to begin: its home, when it is live, and whether it recovers."""

    switch: Switch
    live: asyncio.Future[float]
    recovering: bool


class JournalHome(RecordedHome):
    """A home that numbers what it accepts, journals it, and feeds it; and the clock of the recovery at hand."""

    takes_parcels = True

    def __init__(self, homes: Homes, method: Method, parent: Parent) -> None:
        self.homes, self.method, self.parent = homes, method, parent
        self.switch: Switch | None = None
        self.clock: RecoveryClock | None = None
        self.recovery: Recovery | None = None  # that of the life which is begun now
        self.page: memoryview | None = None  # of a life in this process: which input it has in hand
        self.fault: Literal["", "killed", "hung"] = ""  # why the end that is ordered counts against the turn in hand

    def expect(self, cell: Cell) -> None:
        if self.homes.at(cell.path) is None:
            cell.admit = admit_unread
        else:
            self.take_in(cell)

    def take_in(self, cell: Cell) -> None:
        switch = self.switch = self.homes.expecting(cell, self.method)
        if not switch.ledger.is_new:
            hold(switch)

    def enter(self, cell: Cell) -> Entered:
        """As `open`, and it is a recovery if anything comes back, or if one is not over."""
        self.in_vain = ""
        entered = self.open(cell)
        entered.switch.life.follow()
        recoveries = self.homes.recoveries
        self.recovery = None
        if entered.recovering or recoveries.of(cell.path) is not None:
            self.recovery = recoveries.starts(cell.path, self.method)
            hold(entered.switch)
            entered.switch.life.waits_for_release = recoveries.needs(self.recovery, "release")
        if cell.node.on_life is not None:
            cell.node.on_life(cell)
        return entered

    @property
    def keeps_turns(self) -> bool:
        return self.method.replays

    def goes_on_with(self, key: int) -> bool:
        return self.keeps_turns and self.switch is not None and key in self.switch.open

    @property
    def is_gated(self) -> bool:
        """Whether the recovery of the life at hand waits for somebody on its way, or for the store."""
        if self.switch is not None and not self.switch.images.are_here:
            return True
        return self.recovery is not None and self.homes.recoveries.is_gated(self.recovery)

    async def gate(self, stage: str) -> None:
        """Wait until the recovery may go on to this stage; not for long."""
        recovery = self.recovery
        if recovery is not None:
            wait = self.homes.recoveries.gate(recovery, stage)
            if wait is not None:
                await asyncio.shield(wait)
            if stage == "restart":
                self.isolated()

    def isolated(self) -> None:
        """S2 is over: nothing reaches the actor, and nothing of its old life gets out."""
        if self.recovery is not None:
            self.homes.recoveries.phase(self.recovery, "isolate", time.monotonic())

    def open(self, cell: Cell) -> Entered:
        """A life is to begin: its home holds what comes."""
        switch = self.switch = self.homes.of(cell, self.method)
        if not self.method.replays:
            forget_turns(switch)
        self.clock = self.clock or RecoveryClock()
        self.clock.mark("isolate")
        return Entered(switch, switch.prepare(), not switch.ledger.is_new)

    def subscribe(self, cell: Cell, topics: Iterable[str]) -> None:
        """Have the home admit what is published, also between two lives: on the topics of the class, and its own."""
        switch = self.switch
        assert switch is not None
        end_wait(switch)  # It was subscribed until now, so that nothing was missed.
        intake, before = switch.intake, switch.intake.class_topics
        intake.class_topics = tuple(topics)
        switch.leave_topics(before)
        for topic in (*intake.class_topics, *switch.topics):
            cell.node.topics.subscribe(topic, inlet(switch, topic))

    def has_class(self, cell: Cell, kind: type[Actor]) -> None:
        if self.switch is not None and cell.life and not cell.is_dead:
            self.subscribe(cell, kind._topics)

    def over(
        self,
        cell: Cell,
        running: int,
        why: str,
        *,
        ordered: bool,
        noticed: float | None = None,
        reason: ExitReason | None = None,
        recovers: bool | None = None,
    ) -> None:
        """A life has ended; the home keeps everything.

        Args:
            cell: its address.
            running: the input in hand, -1 if none.
            why: in words.
            ordered: we have killed it, or another life in its process has; a kill that is a fault was not ordered.
            noticed: when its end was noticed, if before now.
            reason: why it has ended; that of the cell if left out.
            recovers: whether it is brought back; judged by its spec if left out.
        """
        switch = self.switch
        if switch is None:
            return
        if self.page is not None:
            self.page[0] = 0
        self.clock = RecoveryClock()
        self.clock.mark("noticed", noticed)
        self.clock.mark("detect")
        end = self.cause(cell.extra().reason if reason is None else reason)
        has_hung, has_begun = self.fault == "hung" or isinstance(end, Hung), not switch.ledger.is_new
        switch.died(running, ordered=ordered and not self.fault, has_hung=has_hung, reason=end)
        self.fault = ""
        if recovers is None:
            recovers = self.recovers(end) and cell.spec is not None and cell.spec.restarts(end)
        if recovers and has_begun:  # Else its first start has failed, and there is nothing to recover.
            hold(switch, running)
            self.homes.recoveries.crashed(cell.path, self.method, noticed)
        cell.extra().belongings.topics.clear()  # These would be unsubscribed with the life.
        switch.life.fail(StartFailed(cell.path, why))
        self.life_ended(switch, end)

    def life_ended(self, switch: Switch, reason: ExitReason) -> None:
        """A life has ended: a home that keeps less than everything forgets the rest."""

    def offer(self, cell: Cell, item: Any) -> Awaitable[None] | None:
        """Admit a message for a sender that waits until it counts."""
        if is_unread(cell):
            self.take_in(cell)
        switch = self.switch
        before = None if switch is None else switch.intake.last
        cell.admit(cell, item)
        last = None if switch is None else switch.intake.last
        return None if switch is None or last is None or last is before else switch.outputs.rows.accepted(last)

    def progress(self, cell: Cell) -> object:
        """How far the replay has come."""
        return None if self.switch is None else self.switch.progress

    def cause(self, reason: ExitReason) -> ExitReason:
        """Its replay has led elsewhere, if that is so: it was killed because of that."""
        diverged = None if self.switch is None else self.switch.life.diverged
        return reason if diverged is None else crash(diverged)

    def recovers(self, reason: ExitReason) -> bool:
        """Whether an end for this reason is followed by a recovery."""
        return not reason.is_clean

    def hangs(self, cell: Cell) -> None:
        self._blame_turn(cell, "hung")

    def faulted(self, cell: Cell, by: str) -> None:
        super().faulted(cell, by)
        self._blame_turn(cell, "killed")

    def _blame_turn(self, cell: Cell, fault: Literal["killed", "hung"]) -> None:
        """The end that comes counts against the turn in hand, unless that rests as it has said."""
        switch = self.switch
        rests = switch is not None and switch.rests_in(cell.host.place.running(cell))
        self.fault = fault if cell.state is RUNNING and not rests else ""

    def is_open(self, cell: Cell) -> bool:
        return self.switch is not None and self.switch.life.is_released

    def backlog(self, cell: Cell, running: int) -> int:
        return 0 if self.switch is None else self.switch.ledger.backlog(self.switch.in_hand(running))

    def work(self, cell: Cell, running: int) -> Work:
        """The input in hand, or the number of the turn that has ended last: the same for every place."""
        switch = self.switch
        if switch is None:
            return Work()
        source = switch.ledger.open.get(switch.in_hand(running))
        turn = cell.more.turn if cell.more is not None else None
        mark: object = switch.ledger.turn if source is None else source
        ended = switch.ledger.turns.get(switch.ledger.turn)
        has_answered = ended is not None and bool(ended.reply) and ended.input.ask is None  # Else it is to come later.
        since, begun = None if turn is None else turn.since, None if source is None else switch.calls.turn_begun()
        return Work(mark, source is not None, since, has_answered, begun=begun)

    def rests(self, cell: Cell) -> list[TurnRest]:
        return [] if self.switch is None else self.switch.calls.resting()

    def may_have_begun(self, cell: Cell, ask: Ask) -> bool:
        """Of an input that has no end: the present life may have it in hand, or an earlier one may have had it."""
        source, switch = self._asked(ask), self.switch
        if source is None or switch is None or not cell.node.clock.is_past(ask.deadline):
            return True
        life = switch.life
        if source.was_cut or source.was_stashed or source.id == switch.ledger.begun or not life.counts:
            return True
        return life.port is not None and cell.host.place.may_have_begun(cell, source.id)

    def withdraw(self, cell: Cell, ask: Ask, then: Callable[[bool], None]) -> None:
        source = self._asked(ask)
        if source is None or self.switch is None:
            then(False)
        else:
            withdraw(self.switch, source, then)

    def _asked(self, ask: Ask) -> Input | None:
        """The input that an ask has become, if it has no end."""
        source = None if self.switch is None else self.switch.open.get(ask.started - 1)
        return source if source is not None and source.ask is ask else None

    def holds_back(self, cell: Cell) -> str:
        """A turn that has ended waits for a store without room: what it has done is kept, and its reply comes then."""
        blocked = self.homes.journal.blocked
        if blocked is None:
            return ""
        return f"in time; do not ask again, for it goes on with this when its store takes something again: {blocked}"

    def mailbox(self, cell: Cell) -> Capacity | None:
        return None if self.switch is None else self.switch.intake.mailbox

    def load(self, cell: Cell) -> int:
        """Messages that wait and those in hand; what the actor has put aside is among them."""
        return 0 if self.switch is None else len(self.switch.ledger.open)

    def push(self, cell: Cell, item: Item) -> None:
        """What comes from others is an input; the rest is of the life in this process."""
        if not isinstance(item, (links.Exit, links.Down)):
            MAILBOX.push(cell, item)
        elif self.switch is not None:
            self.switch.push(item)

    # -- lives in a process -----------------------------------------------------------------------------------------

    async def let_begin(self) -> None:
        await self.gate("restart")
        await self.bring_state()

    async def bring_state(self) -> None:
        """Have the state here with which a life is to begin.

        Raises:
            StartFailed: it cannot be had.
        """
        assert self.switch is not None
        try:
            await self.switch.images.bring()
        except HoldfastError as error:
            raise StartFailed(self.switch.path, str(error)) from error
        if not self.method.replays:  # It may be an older snapshot.
            forget_turns(self.switch)

    def hand_to(self, cell: Cell, worker: Worker) -> dict[str, Any]:
        switch = self.switch
        assert switch is not None
        worker.record_taker = functools.partial(own_records, worker, switch)
        port = RemoteLife(cell.path, worker)
        for record in switch.restore_records():
            port.to_life(record)
        return {"recorded": self.launch_data()}

    def launch_data(self) -> dict[str, Any]:
        """What a process has to know of the life that it begins."""
        switch = self.switch
        assert switch is not None
        return {"method": self.method.data(), "turn": switch.ledger.state_turn, "stash": switch.ledger.stash}

    async def goes_on(self, cell: Cell, worker: Worker, entered: Entered) -> None:
        await self.replay(cell, RemoteLife(cell.path, worker), entered)
        self.clock = None

    def takes_stop(self, cell: Cell) -> bool:
        return self.switch is not None and self.switch.life.is_live

    def in_hand(self, worker: Worker) -> int:
        return input_of(worker.page[0])

    def has_come_to(self, worker: Worker, key: int) -> bool:
        return may_have_begun(worker.page[0], key)

    def lost(self, cell: Cell, worker: Worker | None, reason: ExitReason) -> Callable[[bool | None], None] | None:
        """Keep everything, and count deaths in the same turn."""
        if worker is None or cell.state is not RUNNING:
            return None
        running, noticed = self.in_hand(worker), worker.end.noticed_at
        ordered = is_innocent(worker.page[0], reason, one_works=False)

        def over(recovers: bool | None) -> None:
            self.over(
                cell, running, str(reason), ordered=ordered, noticed=noticed, reason=reason, recovers=recovers
            )  # fmt: skip

        return over

    # -- ends -------------------------------------------------------------------------------------------------------

    def handed_to(self, parent: Parent) -> None:
        self.parent = parent

    def retired(self, cell: Cell) -> None:
        self.give_up(cell)

    def give_up(self, cell: Cell) -> None:
        """The address is free: it hears nothing more, but what must not be lost if it will live again."""
        if self.switch is None:
            return
        restarting = self.parent.is_restarting(cell)
        waits = restarting and self.method.records and self._outlives(cell)
        topics = (*self.switch.intake.class_topics, *self.switch.topics)
        for topic in topics:
            cell.node.topics.unsubscribe(topic, inlet(self.switch, topic))
        end_wait(self.switch)  # Of the life before, if this one has not come so far.
        diverged, reason = self.switch.life.diverged, str(cell.extra().reason)
        gone = MAY_LIVE_AGAIN if restarting else "nobody lives at its address now"
        unfit = reason if UNFIT in reason else gone
        # A start that has failed leaves what waits, and the turn in hand, to one that does not.
        keeps = restarting or diverged is not None or (self.switch.has_past and not self.switch.life.has_come_up)
        drop_all(self.switch, unfit if diverged is None else str(diverged), keep_tells=keeps, keep_asks=waits)
        let_go(self.switch)
        if waits:
            wait_for_next_life(self.switch)
            for topic in topics:
                cell.node.topics.subscribe(topic, inlet(self.switch, topic))
        self.switch.ties.untie()
        if restarting:
            self.switch.life.has_ended = False  # Nobody has dealt with its end yet.
        else:  # Behind what its supervisor notes of it now: else it would be lost with this process.
            cell.node.loop.call_soon(self.switch.forget_end)
        why = "its supervisor has ended" if restarting else "it is not started again"
        self.homes.recoveries.given_up(cell.path, why)

    def _outlives(self, cell: Cell) -> bool:
        """Whether there will be a next life to wait for: a durable store has it in the next program, too."""
        root = cell.node.root
        assert self.switch is not None
        return self.switch.journal.durable or (root is not None and root.state is RUNNING)

    async def replay(self, cell: Cell, port: LifePort, entered: Entered) -> None:
        """The rest of S3, what a life that has begun has handled since; then S4.

        Raises:
            StartFailed: it did not come so far.
        """
        assert self.clock is not None
        assert self.switch is not None
        self.clock.mark("restart")
        await self.gate("replay")
        if not entered.live.done():  # Else it has ended meanwhile.
            self.switch.attach(port)
        await self.until_live(cell, entered)

    async def until_live(self, cell: Cell, entered: Entered) -> None:
        """Wait until a life has caught up, and tell of it.

        Raises:
            StartFailed: it did not.
        """
        node, clock, switch = cell.node, self.clock, self.switch
        assert clock is not None
        assert switch is not None
        try:
            restore_seconds = await entered.live
            if switch.life.port is None:  # It was over before anybody came to look.
                if switch.life.waits_for_release:
                    raise StartFailed(cell.path, ENDED)
                return  # It was up, and has ended in a turn: that is told by its end, and no start has failed.
            clock.mark("replay", switch.life.live_at)
            await self._let_at(switch, clock, restore_seconds)
            await switch.life.settles()
            if switch.life.port is None:
                return  # As above.
        except HoldfastError as error:
            if entered.recovering and not isinstance(error, StartIgnored):  # Else there was nothing to recover.
                node.emit(RecoveryFailed(cell.path, str(error)))
            raise error if isinstance(error, StartFailed) else StartFailed(cell.path, str(error)) from error
        except asyncio.CancelledError:
            diverged = switch.life.diverged
            if diverged is None:
                raise StartFailed(cell.path, "it was stopped while it started") from None
            node.emit(RecoveryFailed(cell.path, str(diverged)))
            raise StartFailed(cell.path, str(diverged)) from diverged
        finally:
            switch.life.settled = None
        if node.events.has_listeners:
            node.emit(ActorStarted(cell.path, cell.life))
        if entered.recovering:
            clock.mark("release")
            if node.events.has_listeners:
                node.emit(Recovered(cell.path, cell.life, switch.life.replayed, clock.phases(restore_seconds)))
        self.homes.recoveries.over(cell.path)

    def start_failed(self, error: StartFailed) -> None:
        self.in_vain = error.reason if is_in_vain(error.reason) else ""

    async def _let_at(self, switch: Switch, clock: RecoveryClock, restore_seconds: float) -> None:
        """S4, if anybody has a say in it; else the home has done it.

        Raises:
            StartFailed: the life has ended meanwhile.
        """
        recovery, port = self.recovery, switch.life.port
        if recovery is None:
            return
        self.homes.recoveries.came_up(recovery, clock.when("restart"), switch.life.live_at, restore_seconds)
        if switch.life.waits_for_release:
            await self.gate("release")
            if port is None or switch.life.port is not port:
                raise StartFailed(switch.path, ENDED)
            switch.life.waits_for_release = False
            switch.let_at()
