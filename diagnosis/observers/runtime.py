"""An observer of what the runtime knows of its actors, without a word of theirs: who gets on, who waits for whom."""

from __future__ import annotations

import dataclasses
import math
import time
from collections import Counter, deque
from collections.abc import Collection, Iterable, Mapping
from typing import Any, Final, NamedTuple

from ...actors.control.orders_lane import OrderAsk
from ...actors.errors import ActorStopped, AskTimeout
from ...actors.events import ActorCrashed, ChildTerminated, DeadLetter, EventStream
from ...actors.exit_reasons import Crash, ExitReason, Normal
from ...actors.kernel.address_host import Work
from ...actors.kernel.cell import RUNNING, Cell
from ...actors.kernel.envelope import Ask, chain_of
from ...actors.kernel.message import Refusal
from ...actors.kernel.node import Node
from ...actors.overflow import DROPS
from ...actors.process.open_asks import open_asks
from ...supervision.intensity import recent_restarts
from ..literals import Literal, crashes, keeps_up, progress, replies, room, waits_for
from .backlog import Backlog
from .node_observer import at_root
from .observer import Manner, Observer
from .refusals import Refusals

LOOKS: Final = 20
"""Looks in which an actor must have got on before a long turn of it says anything: until then only time-outs do."""
LONGER: Final = 4.0
"""Times the longest turn that was seen to end, after which one that others wait for is too long."""
MOST: Final = 2_000
"""Cells and mailbox items that are looked at for asks between processes."""
SHARE: Final = 50.0
"""Times the length of a look that passes between two looks at least: looking takes a fiftieth of the time at most."""
LOOP: Final = 3
"""Ends within `WITHIN` seconds that are a crash loop: crashes, and those in good order of who is always to be there."""
WITHIN: Final = 10.0
USUAL: Final = 10
"""Looks of which the last ones say whom an actor waits for as a rule."""


@dataclasses.dataclass(slots=True)
class _Seen:
    """What was seen of one actor so far."""

    life: int = 0
    mark: object = None
    """What it had in hand at the last look; another one means that it has got on."""
    since: float = 0.0
    """When it was seen to get on for the last time."""
    idle: float = 0.0
    """When it was seen with nothing to do for the last time: who has nothing to do does not stand still."""
    rested: float = -math.inf
    """When it was seen for the last time to rest in its turn, as that has said: in a sleep, or an effect."""
    is_in_turn: bool = False
    """Whether it had something in hand at the last look."""
    turns: int = 0
    """Looks in which it had got on."""
    own_turns: int = 0
    """Turns that its process had told of at the last look."""
    moved: float = -math.inf
    """When it was seen to get on for the last time, by such turns or others."""
    longest: float = 0.0
    """Seconds of the longest turn that was seen to end."""
    longer: list[float] = dataclasses.field(default_factory=list[float])
    """Those of turns that took longer, and behind which it has not been seen with nothing to do yet."""
    full: float | None = None
    """Since when its mailbox takes nothing more."""
    down: float | None = None
    """Since when it is not up."""
    unanswered: deque[tuple[float, float]] = dataclasses.field(default_factory=lambda: deque(maxlen=16))
    """When asks of it have failed, and when they were made."""
    refused: float = -math.inf
    """When it has refused what it was asked for the last time."""
    no: Ask | None = None
    """The ask that it has refused then."""
    crashes: tuple[float, ...] = ()
    backlog: Backlog = dataclasses.field(default_factory=Backlog)
    waited: deque[str] = dataclasses.field(default_factory=lambda: deque(maxlen=USUAL))
    """Whom it waited for at the last looks."""
    denied: dict[Literal, float] = dataclasses.field(default_factory=dict[Literal, float])
    """When there was a reason for the last time to say that something does not hold."""

    def take(self, work: Work, life: int, now: float, patience: float) -> bool:
        """Learn from what it has in hand at a look. Returns whether it has got on since the last one."""
        if self.life != life:
            self.life, self.mark, self.since = life, work.mark, now
            self.unanswered.clear()
            self.backlog.clear()
            self.longer.clear()
        has_got_on = work.mark is not self.mark
        if has_got_on or (self.is_in_turn and not work.is_in_turn):  # A turn is over that was seen, or that was missed.
            stood = now - max(self.since, self.idle)
            if stood > self.longest and (self.is_in_turn or stood > patience):
                self.longer.append(stood)
            # Of who is not known yet all is usual; and who never has nothing to do goes on like this.
            if self.turns < LOOKS or len(self.longer) >= LOOKS:
                self.learn()
        self.is_in_turn = work.is_in_turn
        if has_got_on:
            self.mark, self.turns = work.mark, self.turns + 1
            self.since = now if work.since is None else max(work.since, self.since)
        return has_got_on

    def learn(self) -> None:
        """How long its turns have taken is usual, as it has come to their end; until then they may only get longer."""
        self.longest = max(self.longest, *self.longer, 0.0)
        self.longer.clear()


class _Shown(NamedTuple):
    """What one look shows of an actor that is up."""

    is_late: bool
    """Others wait for it too long, or messages do, while it does not rest as it has said."""
    since: float
    """When that began which makes it late, if it is."""
    is_asked: bool
    """An ask of it waits, or has run out lately."""
    is_full: bool
    """Its mailbox has taken nothing for too long."""
    is_bounded: bool
    has_got_on: bool
    has_answered: bool


class RuntimeObserver(Observer):
    """Says who gets on, answers, keeps up, ends again and again, whose mailbox is full, and who waits for whom.

    An actor is late if asks of it were not answered in time, or if others wait for it, up or not, longer than the
    longest turn it was seen to need, four times over, and had nothing to do behind; and so are all whose turns have
    waited for each other in a circle for `patience`. An actor is late as well if messages wait that it was only told;
    but then it may rest, in a sleep or an effect of its own (`ctx.sleep`, `ctx.effect`). Who is late because it waits
    for another one is not accused: the last one in that row is, also if a mailbox only grows because each turn waits
    for it. If the row leads back to its beginning, all in the circle are. Whether an actor answers is said only if it
    was asked. What is said against one is taken back when it is true again, and else is unknown `time_to_live` seconds
    after the last reason for it.

    Args:
        actors: component to address; it may change, and what is in it at a look is looked at.
        patience: seconds; what takes no longer is not too long.
        asked: where to note who was seen to ask whom, by component.
        manner: see `Observer`; `every` is stretched, so that looking takes no more than a fiftieth of the time.
    """

    def __init__(
        self,
        actors: Mapping[str, str],
        *,
        patience: float = 1.0,
        asked: dict[str, set[str]] | None = None,
        manner: Manner | None = None,
    ) -> None:
        super().__init__(manner=manner or Manner(every=0.1))
        if not patience > 0:
            raise ValueError(f"patience is {patience!r}; it must be > 0 seconds")
        self._actors, self._patience = actors, patience
        self._asked = {} if asked is None else asked
        self._known: dict[str, _Seen] = {}
        self._failed: list[tuple[Ask, BaseException]] = []
        self._stream: EventStream | None = None
        self._rests_until = 0.0
        self._loops: set[str] = set()  # who ends again and again
        self._let_down: dict[str, float] = {}  # when an ask of theirs has failed
        self._refusals = Refusals(2 * self.manner.every)
        self._waiting: set[Literal] = set()

    def on_start(self, restored: bool) -> None:
        """Begin to listen for failures. Raises SpecError in a process of its own."""
        at_root(self)
        super().on_start(restored)
        self._stream = self._node.events.listen()
        self._node.deadlines.watcher = self._note

    async def on_stop(self, reason: ExitReason) -> None:
        """Listen no more: it costs nothing from then on."""
        if self._stream is not None:
            self._stream.close()
        if self._node.deadlines.watcher == self._note:
            self._node.deadlines.watcher = None
        await super().on_stop(reason)

    @property
    def _node(self) -> Node:
        return self.ctx._cell.node

    def _note(self, ask: Ask, error: BaseException) -> None:
        if len(self._failed) < MOST and not isinstance(ask, OrderAsk):  # Orders pass ahead of messages: no work of its.
            self._failed.append((ask, error))

    def spares(self, grace: Any, about: Literal) -> bool:
        """How often it ends is just what is to be known."""
        return self._loops.isdisjoint(about.args) and super().spares(grace, about)

    def afresh(self, names: Collection[str]) -> None:
        """What was late before somebody acted says nothing of after."""
        for seen in (seen for component, seen in self._known.items() if component in names):
            seen.unanswered.clear()
            seen.waited.clear()
            seen.full = None
            seen.backlog.clear()
        self._refusals.forget(names)

    # -- looking ----------------------------------------------------------------------------------------------------

    def look(self) -> None:
        """Look at all actors, and say who gets on and who does not."""
        now = self.now
        if now < self._rests_until:
            return
        began = time.thread_time()  # What others compute meanwhile is not counted.
        names = {path: component for component, path in self._actors.items()}
        for gone in self._known.keys() - self._actors.keys():
            del self._known[gone]
        self._take_failures(names)
        self._take_ends(names)
        waits, asked_since = self._waits(names, now)
        shown: dict[str, _Shown] = {}
        for component, path in self._actors.items():
            cell = self._node.find(path)
            if cell is not None and cell.state is RUNNING and cell.host.is_up(cell):
                if self._seen(component).down is not None:
                    self._come_back(component)
                shown[component] = self._look_at(component, cell, asked_since.get(component), waits, now)
            elif (of_it := self._look_at_place(component, asked_since.get(component), now)).is_late:
                shown[component] = of_it
            elif component not in self._loops:
                for atom in (progress(component), replies(component), room(component), keeps_up(component)):
                    self.verdict(atom, None)
        for circle in self._circles(waits, shown, now):
            waits |= {component: {following} for component, following in circle.items()}
            shown |= {component: shown[component]._replace(is_late=True, is_asked=True) for component in circle}
        self._tell(shown, waits)
        if self._node.clock.is_monotonic:
            self._rests_until = now + (time.thread_time() - began) * SHARE

    def _waits(self, names: Mapping[str, str], now: float) -> tuple[dict[str, set[str]], dict[str, float]]:
        """Who waits for whom, and since when the oldest ask of each waits."""
        waits: dict[str, set[str]] = {}
        since: dict[str, float] = {}
        for to, ask in open_asks(self._node, MOST):
            callee = names.get(to.path)
            if callee is None or isinstance(ask, OrderAsk):
                continue
            since[callee] = min(since.get(callee, now), ask.deadline - ask.timeout)
            asker = names.get(ask.sender.path) if ask.sender is not None else None
            if asker is not None and asker != callee and ask.chain:
                waits.setdefault(asker, set()).add(callee)
                self._asked.setdefault(asker, set()).add(callee)
        return waits, since

    def _circles(self, waits: Mapping[str, set[str]], shown: Mapping[str, _Shown], now: float) -> list[dict[str, str]]:
        """Who waits for whom where it leads back: each one's turn has stood for long, and waits for nothing else."""
        left = {component: {to for to in of_it if to in waits} for component, of_it in waits.items()}
        while ends := {component for component, of_it in left.items() if not of_it}:
            left = {component: of_it - ends for component, of_it in left.items() if of_it}
        after: dict[str, str] = {}
        for component in left:
            cell = self._node.find(self._actors[component])
            if component not in shown or cell is None or now - self._seen(component).since <= self._patience:
                continue
            awaited = cell.host.awaits(cell)
            after.update((component, to) for to in left[component] if self._actors[to] == awaited)
            cell.host.ask_turns(cell)  # for the next look
        circles: list[dict[str, str]] = []
        while after:
            at, row = next(iter(after)), dict[str, str]()
            while at in after:
                row[at] = after.pop(at)
                at = row[at]
            if at in row:
                first = list(row).index(at)
                circles.append(dict(list(row.items())[first:]))
        return circles

    def _take_failures(self, names: Mapping[str, str]) -> None:
        failed, self._failed = self._failed, []
        for ask, error in failed:
            callee = names.get(ask.to.path)
            asker = names.get(ask.sender.path) if ask.sender is not None else None
            if asker is not None and callee not in (None, asker) and chain_of(ask):
                self._asked.setdefault(asker, set()).add(callee)
            # That is an answer, and says nothing of whether it could have given another.
            if isinstance(error, Refusal):
                if callee is not None:
                    self._seen(callee).refused, self._seen(callee).no = self.now, ask
                    self._refusals.take(asker, callee, error, self.now)
                continue
            if callee is not None and isinstance(error, AskTimeout):
                self._seen(callee).unanswered.append((self.now, self.now - ask.timeout))
            is_nobody = callee is None and isinstance(error, ActorStopped)  # That it asks there is its own fault.
            if asker is not None and asker != callee and not is_nobody:
                self._let_down[asker] = self.now

    def _take_ends(self, names: Mapping[str, str]) -> None:
        """Ends by themselves; who could not bear that another one did not answer is not to blame."""
        assert self._stream is not None
        for event in self._stream.take():
            component = names.get(event.address)
            match event:
                case ActorCrashed(reason=Crash() as reason) | ChildTerminated(reason=Normal() as reason):
                    pass
                case DeadLetter() if component is not None:
                    self._refusals.take_end(component, event, self.now)
                    continue
                case _:
                    continue
            was_let_down = self.now - self._let_down.get(component or "", -math.inf) <= 2 * self.manner.every
            if component is not None and not (was_let_down or _is_anothers(reason)):
                seen = self._seen(component)
                seen.crashes = (*seen.crashes, self.now)
        for seen in self._known.values():
            seen.crashes = recent_restarts(seen.crashes, self.now, WITHIN)
        self._loops = {component for component, seen in self._known.items() if len(seen.crashes) >= LOOP}

    def _seen(self, component: str) -> _Seen:
        seen = self._known.get(component)
        if seen is None:
            seen = self._known[component] = _Seen(since=self.now)
        return seen

    def _look_at(
        self, component: str, cell: Cell, asked_since: float | None, waits: Mapping[str, set[str]], now: float
    ) -> _Shown:
        seen = self._seen(component)
        work, backlog = cell.host.work(cell), cell.host.backlog(cell)
        has_got_on = seen.take(work, cell.life, now, self._patience)
        has_moved = has_got_on or work.own_turns != seen.own_turns
        seen.own_turns, seen.moved = work.own_turns, now if has_moved else seen.moved
        if has_got_on and work.has_answered and work.newest is not seen.no:
            self._refusals.answers(component)
        waits_now = sorted(waits.get(component, ()))
        seen.waited.append(waits_now[0] if waits_now else "")
        usual = max(self._patience, LONGER * seen.longest)
        limit = usual if seen.turns >= LOOKS else float("inf")
        is_busy = work.is_in_turn or backlog > 0
        if not is_busy:
            seen.idle = now
            seen.learn()
        while seen.unanswered and now - seen.unanswered[0][0] > self.manner.time_to_live:
            seen.unanswered.popleft()
        stood = now - max(seen.since, seen.idle)
        keeps_waiting = asked_since is not None and min(stood, now - asked_since) > limit
        # Who tells it something does not wait for that: it may rest in its turn, now and then for a moment in no wait.
        if is_busy and backlog > 0 and 2 * stood > self._patience:
            seen.rested = now if cell.host.rests(cell) else seen.rested
            cell.host.ask_turns(cell)  # for the next look
        is_at_rest = is_busy and stood > usual and now - seen.rested <= usual
        stands = is_busy and backlog > 0 and stood > limit and not is_at_rest
        if is_at_rest:  # What waits does so because of the outside: that is no leak.
            seen.backlog.clear()
            self.verdict(keeps_up(component), None)
        else:
            aside = len(cell.more.stash or ()) if cell.more is not None else 0  # It may never be taken up again.
            seen.backlog.take(backlog + aside, now)
        # A turn that was under way when an ask of it ran out, and still is; or several asks that ran out.
        unanswered = [at for at, made in seen.unanswered if is_busy and seen.since <= max(made, at - self._patience)]
        is_late = keeps_waiting or stands or bool(unanswered) or len(seen.unanswered) > 1
        since = min((made for _, made in seen.unanswered), default=now - stood)
        return _Shown(
            is_late,
            since,
            asked_since is not None or bool(seen.unanswered),
            self._is_full(component, cell, now),
            cell.host.mailbox(cell) is not None,
            has_moved,
            has_got_on and work.has_answered and not seen.unanswered,
        )

    def _look_at_place(self, component: str, asked_since: float | None, now: float) -> _Shown:
        """What is seen where nobody is up: whether those who ask there are left waiting longer than by a usual turn."""
        seen = self._seen(component)
        seen.down = now if seen.down is None else seen.down
        seen.full = None
        seen.waited.clear()
        seen.backlog.clear()
        usual = max(self._patience, LONGER * seen.longest)
        ran_out = any(made >= seen.down - self._patience for at, made in seen.unanswered if at > seen.down)
        waits = asked_since is not None and seen.turns >= LOOKS and now - max(asked_since, seen.down) > usual
        is_late = now - seen.down > usual and (ran_out or waits)
        return _Shown(is_late, seen.down, True, False, False, False, False)

    def _come_back(self, component: str) -> None:
        """It is up again: that those who asked had to wait for that says nothing of the life that has begun."""
        self._seen(component).down = None
        for atom in (progress(component), replies(component)):
            if component not in self._loops:
                self.verdict(atom, None)

    def _is_full(self, component: str, cell: Cell, now: float) -> bool:
        """Whether its mailbox has taken nothing for too long."""
        seen, bound = self._seen(component), cell.host.mailbox(cell)
        turns_away = bound is not None and bound.overflow not in DROPS and bound.count >= bound.capacity
        seen.full = None if cell.has_room and not turns_away else now if seen.full is None else seen.full
        return seen.full is not None and now - seen.full >= self._patience

    # -- blaming ----------------------------------------------------------------------------------------------------

    def _tell(self, shown: Mapping[str, _Shown], waits: Mapping[str, set[str]]) -> None:
        """Accuse whoever those who are late wait for in the end, and say of the others what they were seen to do."""
        waiting: set[Literal] = set()
        accused = self._ends((one for one, of_it in shown.items() if of_it.is_late or of_it.is_full), waits, waiting)
        awaited = {literal.args[1] for literal in waiting}
        growing = [one for one in shown if self._known[one].backlog.has_grown]
        # What they wait for at just this moment says little: they get on.
        overrun = self._ends(growing, {}, waiting)
        for component, of_it in shown.items():
            is_blamed, is_awaited = component in accused, component in awaited
            self._tell_room(component, of_it, is_blamed=is_blamed)
            if is_blamed and (of_it.is_late or is_awaited):
                self._deny(progress(component), of_it.since)
                if of_it.is_asked or is_awaited:
                    self._deny(replies(component), of_it.since)
                else:
                    self.verdict(replies(component), self._kept(replies(component)))
            elif of_it.is_late or (of_it.is_full and not is_blamed):
                self.verdict(progress(component), None)
                self.verdict(replies(component), None)
            elif component not in self._loops:
                self._tell_good(component, of_it)
            backlog, was = self._known[component].backlog, self.said(keeps_up(component))
            is_known = None if was is False or component in growing else was
            is_empty = backlog.is_empty and self._known[component].turns > 0
            holds = False if component in overrun else True if is_empty else is_known
            self.verdict(keeps_up(component), holds, backlog.since)
        for over in self._waiting - waiting:
            self.verdict(over, None)
        self._waiting = waiting
        for one in waiting:
            self.verdict(one, True)
        for component in self._known:
            self.verdict(crashes(component), True if component in self._loops else None)
            if component in self._loops:
                self._deny(progress(component))

    def _tell_room(self, component: str, of_it: _Shown, *, is_blamed: bool) -> None:
        is_known = of_it.is_bounded and (is_blamed or not of_it.is_late)
        self.verdict(room(component), (False if is_blamed else None) if of_it.is_full else True if is_known else None)

    def _tell_good(self, component: str, of_it: _Shown) -> None:
        """Say of who is not late what it was seen to do, and for a while what it was seen to do before."""
        seen, now, keeps = self._known[component], self.now, self.manner.time_to_live
        was = None if now - max(seen.since, seen.moved) > keeps else self._kept(progress(component))
        self.verdict(progress(component), True if of_it.has_got_on else was)
        if self._refusals.lets_down(component, now):
            self._deny(replies(component))
            return
        has_refused = now - seen.refused <= keeps
        was = self._kept(replies(component))
        self.verdict(replies(component), None if has_refused else True if of_it.has_answered else was)

    def _deny(self, atom: Literal, since: float | None = None) -> None:
        """There is a reason to say that it does not hold; `since` is when that began."""
        self._seen(atom.args[0]).denied[atom] = self.now
        self.verdict(atom, False, since)

    def _kept(self, atom: Literal) -> bool | None:
        """What was said of it before: that it does not hold only as long as the last reason for that is fresh."""
        said = self.said(atom)
        last = self._seen(atom.args[0]).denied.get(atom, -math.inf)
        return None if said is False and self.now - last > self.manner.time_to_live else said

    def _ends(self, late: Iterable[str], waits: Mapping[str, Iterable[str]], waiting: set[Literal]) -> set[str]:
        """Who is at the end of the rows that begin with these; who waits for whom in them is noted in `waiting`."""
        ends: set[str] = set()
        for component in late:
            row = [component]
            while (following := self._awaited(row[-1], waits)) is not None:
                waiting.add(waits_for(row[-1], following))
                if following in row:
                    ends.update(row[row.index(following) :])
                    break
                row.append(following)
            else:
                ends.add(row[-1])
        return ends

    def _awaited(self, component: str, waits: Mapping[str, Iterable[str]]) -> str | None:
        """Whom an actor waits for now, or waited for at most of the last looks."""
        now = sorted(one for one in waits.get(component, ()) if one in self._actors)
        if now:
            return now[0]
        seen = self._known.get(component)
        if seen is None or not seen.waited:
            return None
        usual, count = Counter(seen.waited).most_common(1)[0]
        return usual if usual and 2 * count > len(seen.waited) and usual in self._actors else None


def _is_anothers(reason: Crash | Normal) -> bool:
    """Whether an actor crashed because another one did not answer; of one in a process nothing else is known."""
    others = ("AskTimeout", "AskFailed", "RemoteCrash")
    return isinstance(reason, Crash) and reason.type_name.rpartition(".")[2] in others
