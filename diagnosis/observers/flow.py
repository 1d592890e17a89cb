"""An observer of whether topics flow as they did, measured by what they are made from: more is never a fault."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable, Collection, Mapping
from copy import copy
from pathlib import Path
from typing import Any, Final

import msgspec

from ...actors.events import Event, LogLine
from ...actors.exit_reasons import ExitReason
from ...actors.kernel.actor import on
from ...actors.kernel.address_host import Work
from ...actors.kernel.cell import Cell
from ...actors.kernel.node import Node
from ...supervision.services.program import Program
from ..kept_file import read_kept, write_kept
from ..literals import ok, word_for
from ..own_time import OwnTime
from .hearing import Heard, listen
from .observer import Manner, Observer

ENOUGH: Final = 20
"""Messages after which something is known of a topic."""
LONGER: Final = 4.0
"""Times the longest silence so far, after which a topic that should flow is silent for too long."""
REGULAR: Final = 3.0
"""Times its mean silence, up to which one is in the rhythm of a topic that goes by a clock."""
MOMENT: Final = 1.0
"""Seconds of a silence that is out of rhythm by a moment only: such are soon forgiven."""
FORGIVEN: Final = 20.0
"""Times the seconds of its silences out of rhythm, after which a topic goes by a clock all the same."""
LONG_FORGIVEN: Final = 1000.0
"""The same, of those that are longer than a moment."""
BLOCK: Final = 50
"""Messages that come in, at least, over which those that go out are counted."""
BLOCKS: Final = 6
"""Blocks from which it is known how much goes out at least."""
TOO_OFTEN: Final = 3
"""Silences that were told as faults, and have ended by themselves, after which the next ones are usual."""
STEADY: Final = 5.0
"""Seconds for which a program must have printed before its lines go by a clock: one that starts has much to say."""
MOST_ARRIVALS: Final = 50_000
"""Messages that are noted while nobody observes yet."""
Arrival = tuple[str, float]
"""The topic of a message that was heard, and when that was, in seconds on the loop clock."""


class Usual(msgspec.Struct):
    """What was learned of a topic; it goes on being learned.

    Attributes:
        count: messages.
        mean_gap: seconds between two of them on average, of late.
        longest_gap: seconds of the longest silence.
        most_in: most that came in between two messages.
        blocks: blocks of inputs that were counted.
        least_out: the smallest part of what came in that went out, of all blocks; of two poor ones in a row neither.
        seconds: of all silences.
        odd_seconds: of those that were out of rhythm.
        long_seconds: of those that were out of rhythm by more than a moment.
        made: messages before which something had come in.
    """

    count: int = 0
    mean_gap: float = 0.0
    longest_gap: float = 0.0
    most_in: int = 0
    blocks: int = 0
    least_out: float = 1.0
    seconds: float = 0.0
    odd_seconds: float = 0.0
    long_seconds: float = 0.0
    made: int = 0

    @property
    def in_doubt(self) -> float:
        """What has to come in beyond what is usual: the more messages have shown what that is, the less."""
        return ENOUGH // 2 * min(1.0, ENOUGH / max(1, self.made))

    @property
    def goes_by_clock(self) -> bool:
        """Whether its silences are alike, but for hiccups: a twentieth of the time, of long ones a thousandth."""
        if self.longest_gap <= REGULAR * self.mean_gap:
            return True
        # Of an older file only the longest is known.
        odd_seconds = max(self.odd_seconds, self.longest_gap)
        long_seconds = max(self.long_seconds, self.longest_gap if self.longest_gap > MOMENT else 0.0)
        return FORGIVEN * odd_seconds <= self.seconds and LONG_FORGIVEN * long_seconds <= self.seconds

    def take(self, gap: float, came_in: int) -> None:
        """Learn of one more message."""
        self.count += 1
        self.mean_gap += (gap - self.mean_gap) / min(self.count, 1000)
        self.longest_gap = max(self.longest_gap, gap)
        self.most_in = max(self.most_in, came_in)
        self.made += came_in > 0
        self.seconds += gap
        if gap > REGULAR * self.mean_gap:
            self.odd_seconds += gap
            self.long_seconds += gap if gap > MOMENT else 0.0

    def take_block(self, part: float) -> None:
        """Learn of one more block of inputs, of which `part` has gone out."""
        self.least_out = min(self.least_out, part) if self.blocks else part
        self.blocks += 1


class Baselines:
    """What is usual of each topic. Given to an observer it outlives its lives, and with a file the program's.

    Args:
        path: where it is kept; None: nowhere.
        by_hour: learn each hour of the day by itself, in local time.

    Raises:
        ValueError: the file is no such file.
    """

    def __init__(self, path: str | Path | None = None, *, by_hour: bool = False) -> None:
        self._path, self._by_hour = None if path is None else Path(path), by_hour
        self._known: dict[str, Usual] = {}
        if self._path is not None:
            self._known = read_kept(self._path, dict[str, Usual], "baselines") or {}

    def of(self, topic: str, wall: float) -> Usual:
        """What is known of a topic at a Unix time; nothing at first."""
        key = f"{topic}@{time.localtime(wall).tm_hour}" if self._by_hour else topic
        learned = self._known.get(key)
        if learned is None:
            learned = self._known[key] = Usual()
        return learned

    async def save(self) -> None:
        """Write what is known to the file, if there is one: whole, or not at all."""
        if self._path is not None:
            await asyncio.to_thread(
                write_kept, self._path, {topic: copy(usual) for topic, usual in self._known.items()}
            )


class FlowSource(msgspec.Struct, frozen=True):
    """How a topic comes about: the addresses of its publishers, and the topics that all they publish is made from.

    `is_lines`: it is what a program prints, which is silent for too long only if it has gone by a clock.
    """

    publishers: tuple[str, ...]
    inputs: tuple[str, ...] = ()
    is_lines: bool = False


class _Flow:
    """What is seen of one topic."""

    __slots__ = (
        "began", "came_in", "due", "guess", "in_block", "inputs", "is_cut", "is_missed", "last", "lives", "missed",
        "out_of_block", "poor", "recent", "seen", "since", "waited", "works",
    )  # fmt: skip

    began: float
    due: float
    """When the first of what has come in since the last message did."""
    since: float | None
    """When the silence began that is told, on the loop clock."""
    last: float | None
    waited: float
    """Seconds in which its publishers have waited for replies since the last message."""
    recent: list[float]

    def __init__(self, now: float) -> None:
        self.works: list[Work] = []  # of its publishers, at the last look
        self.lives: tuple[int, ...] = ()  # of its publishers
        self.is_cut = False  # one of them was started again since the last message
        self.is_missed = False  # it should flow, and does not
        self.inputs = set[str]()  # what it was made from when the last message came, or since
        self.guess = self.seen = self.missed = 0
        self.begin(now)

    def most_in(self, learned: Usual) -> int:
        """Most that comes in between two messages: until that was seen often enough, no less than was guessed."""
        return learned.most_in if self.seen >= ENOUGH else max(learned.most_in, self.guess)

    def begin(self, now: float) -> None:
        """Nothing that came before counts."""
        self.began = self.due = now
        self.last = self.since = None
        self.came_in = self.in_block = self.out_of_block = self.poor = 0
        self.waited = 0.0
        self.recent = []

    def look_at(self, publishers: list[Cell]) -> None:
        """See whether one of its publishers was started again."""
        lives = tuple(cell.life for cell in publishers)
        if lives != self.lives:
            self.lives, self.is_cut = lives, bool(self.lives)

    def takes_silence(self) -> bool:
        """A silence has just ended: whether it is to be learned.

        Not one in which a publisher was started again, nor one that was told as a fault, unless that happens again and
        again and ends by itself: such is the way of that topic.
        """
        is_cut, is_missed = self.is_cut, self.is_missed
        self.is_cut = self.is_missed = False
        self.missed += is_missed and not is_cut
        return not is_cut and (not is_missed or self.missed >= TOO_OFTEN)

    def end_block(self, learned: Usual) -> None:
        """Compare what has gone out of a block of inputs with what is usual; a single poor one is usual, too.

        What is learned is two blocks old: so the one in which it became poor makes no other poor one usual.
        """
        part, self.in_block, self.out_of_block = self.out_of_block / self.in_block, 0, 0
        is_poor = learned.blocks >= BLOCKS and part < learned.least_out / 2
        self.poor = self.poor + 1 if is_poor else 0
        self.recent = [*self.recent, part] if self.poor < 2 else []
        if len(self.recent) > 2:
            learned.take_block(self.recent.pop(0))


class FlowObserver(Observer):
    """Says `ok(topic)` while a topic flows, and that it does not where it should.

    A topic should flow while its inputs come; one without inputs, while its publishers have turns, or if it goes by a
    clock. What its publishers hear no more is an input until a message goes out without it. It is silent for too long
    after four times what came in, and a few more while little is known, or after four times what has passed, between
    two messages at most so far. Of what comes in, at least half of the usual part must go out. Until enough was heard,
    and while nothing comes in, nothing is known.

    Args:
        made: topic to how it comes about; it may change.
        heard: where to note who publishes what, by address.
        leave_out: topics that are not listened to.
        patience: seconds of silence that are never too long, from when something has come in; time in which a publisher
            waits for a reply is added to it, up to as much again.
        baselines: what is usual.
        arrivals: what was heard before; it is learned from once, and taken out.
        manner: see `Observer`.
    """

    def __init__(
        self,
        made: Mapping[str, FlowSource],
        *,
        heard: dict[str, set[str]] | None = None,
        leave_out: Collection[str] = (),
        patience: float = 2.0,
        baselines: Baselines | None = None,
        arrivals: list[Arrival] | None = None,
        manner: Manner | None = None,
    ) -> None:
        super().__init__(manner=manner or Manner(every=0.2))
        if not patience > 0:
            raise ValueError(f"patience is {patience!r}; it must be > 0 seconds")
        self._made, self._heard_of = made, {} if heard is None else heard
        self._leave_out, self._patience = frozenset(leave_out), patience
        self._baselines = baselines or Baselines()
        self._arrivals = [] if arrivals is None else arrivals
        self._flows: dict[str, _Flow] = {}
        self._users: dict[str, list[_Flow]] = {}
        self._ears: set[str] = set()
        self._saved = 0.0

    def on_start(self, restored: bool) -> None:
        """Begin to look, and to keep the time in which the loop was not late: only that is anybody's silence."""
        self._time = OwnTime(self.ctx._cell.node.loop)
        if self.ctx._cell.node.clock.is_monotonic:  # Else it jumps from moment to moment, and is never late.
            self.ctx.create_task(self._time.keep())
        self.ctx.create_task(hear_lines(self.ctx._cell.node, self._heard_line))
        super().on_start(restored)

    def _heard_line(self, program: str) -> None:
        topic = lines_topic(program)
        self._heard_of.setdefault(program, set()).add(topic)
        self._arrived(topic, self._time.now())

    @on(Heard)
    def _heard(self, message: Heard) -> Any:
        if message.sender is not None:
            self._heard_of.setdefault(message.sender, set()).add(message.topic)
        self.hear(message.topic, message.message)

    def hear(self, topic: str, message: Any) -> None:
        """Learn how long the topic was silent, and how much has come in meanwhile."""
        self._arrived(topic, self._time.now())

    def _arrived(self, topic: str, now: float) -> None:
        flow = self._flows.get(topic)
        if flow is not None:
            if flow.last is not None:
                learned, gap = self._learned(topic), now - flow.last
                if gap > learned.longest_gap or flow.came_in > learned.most_in:
                    flow.look_at(self._publishers(self._made[topic]))
                if flow.takes_silence():
                    learned.take(gap, flow.came_in)
                    flow.seen += flow.came_in > 0
            flow.last, flow.came_in, flow.waited = now, 0, 0.0
            flow.inputs.intersection_update(self._made[topic].inputs)
            flow.out_of_block += 1
        for user in self._users.get(topic, ()):
            user.due = user.due if user.came_in else now
            user.came_in += 1
            user.in_block += 1

    def afresh(self, names: Collection[str]) -> None:
        """What came before somebody acted says nothing of after; other topics have nothing to do with it."""
        for topic, flow in self._flows.items():
            if word_for(topic) in names:
                flow.begin(self._time.now())

    async def look(self) -> None:
        """Listen to topics that are new, and say which flow."""
        node = self.ctx._cell.node
        for topic in {*node.topics.names(), *self._made} - self._ears - self._leave_out:
            self._ears.add(topic)
            listen(self, topic)
        if self._flows.keys() != self._made.keys():
            for gone in self._flows.keys() - self._made.keys():
                del self._flows[gone]
            for new in self._made.keys() - self._flows.keys():
                self._flows[new] = _Flow(self._time.now())
        self._users = {}
        for topic, made in self._made.items():
            flow = self._flows[topic]
            flow.inputs.update(made.inputs)
            for wanted in flow.inputs:
                self._users.setdefault(wanted, []).append(flow)
        self._learn_from_before()
        seen = {topic: self._flows_well(topic, made) for topic, made in self._made.items()}
        for topic in self._seen_to_come(seen):
            seen[topic] = True
        for topic, flows in seen.items():
            self.verdict(ok(word_for(topic)), flows, self._flows[topic].since)
        if self.now - self._saved > 60.0:
            self._saved = self.now
            await self._baselines.save()

    def _seen_to_come(self, seen: Mapping[str, bool | None]) -> set[str]:
        """Topics of which nothing is known just now, as nothing comes, and by whose messages another one is missed.

        It is missed by what has come: its inputs are not to blame, however long they pause behind that.
        """
        came = set[str]()
        for flow in (self._flows[topic] for topic, flows in seen.items() if flows is False):
            for wanted in flow.inputs:
                last = self._flows[wanted].last if seen.get(wanted, False) is None else None
                if last is not None and (flow.poor > 1 or last >= flow.due):
                    came.add(wanted)
        return came

    async def on_stop(self, reason: ExitReason) -> None:
        """Keep what was learned beyond this life."""
        await super().on_stop(reason)
        await self._baselines.save()

    def _learn_from_before(self) -> None:
        """Learn what was usual while the model was made; from then until now nobody listened, so that is no silence."""
        if self._arrivals:
            for topic, when in self._arrivals:
                flow = self._flows.get(topic)
                if flow is not None and flow.last is not None and not self._made[topic].inputs:
                    # As if its publishers had had turns at each look: too much is no false alarm. It is not learned,
                    # as whoever publishes in bursts would be allowed many more bursts without a message for ever.
                    flow.guess = max(flow.guess, math.ceil((when - flow.last) / self.manner.every))
                self._arrived(topic, when)
            self._arrivals.clear()
            for flow in self._flows.values():
                flow.begin(self._time.now())

    def _learned(self, topic: str) -> Usual:
        return self._baselines.of(topic, self.ctx._cell.node.clock.wall())

    def _publishers(self, made: FlowSource) -> list[Cell]:
        return [cell for path in made.publishers if (cell := self.ctx._cell.node.find(path)) is not None]

    def _flows_well(self, topic: str, made: FlowSource) -> bool | None:
        flow, now = self._flows[topic], self._time.now()
        learned = self._learned(topic)
        cells = self._publishers(made)
        works = [cell.host.work(cell) for cell in cells]
        flow.look_at(cells)
        if not flow.inputs:  # Its publishers' turns are what comes in.
            had_turns = not made.is_lines and len(works) == len(flow.works) and any(map(_had_turns, flow.works, works))
            flow.due = flow.due if flow.came_in else now
            flow.came_in, flow.works = flow.came_in + had_turns, works
        silent = now - (flow.began if flow.last is None else flow.last)
        if not flow.inputs or 2 * silent > self._patience:
            for cell in cells:
                cell.host.ask_turns(cell)  # for the next look
        if flow.last is None and learned.count < ENOUGH:
            return None
        if learned.count < ENOUGH:
            return True if silent < self._patience else None
        # Who waits for another one's reply is silent by that; whoever looks at turns says who is late.
        flow.waited += self.manner.every if any(cell.host.awaits(cell) for cell in cells) else 0.0
        patience = self._patience + min(flow.waited, self._patience)
        is_long = silent > max(patience, LONGER * learned.longest_gap)
        is_due = flow.came_in > learned.in_doubt + LONGER * flow.most_in(learned)
        # A burst, however many messages are in it, has no rhythm yet.
        is_steady = learned.seconds > (STEADY if made.is_lines else self._patience)
        is_by_clock = not flow.inputs and is_steady and learned.goes_by_clock
        flow.since = None
        is_due = is_due and now - flow.due > patience
        if is_due or (is_by_clock and is_long):
            flow.is_missed, flow.since = True, self.now - (now - flow.due if is_due else silent)
            return False
        if flow.inputs and flow.in_block >= BLOCK and all(map(_is_idle, cells, works)):  # All of it was worked off.
            flow.end_block(learned)
        if flow.poor > 1:
            return False
        return True if flow.last is not None and silent < max(self._patience, LONGER * learned.mean_gap) else None


def _had_turns(before: Work, now: Work) -> bool:
    return now.mark is not before.mark or now.own_turns != before.own_turns


def _is_idle(cell: Cell, work: Work) -> bool:
    return not work.is_in_turn and not cell.host.backlog(cell)


# -- lines that programs print for an actor: a topic of the program --------------------------------------------------


def lines_topic(program: str) -> str:
    """The name under which the lines of the program at an address are a topic."""
    return f"{program}.lines"


def told_lines(cell: Cell) -> str | None:
    """The address of whoever is told the lines of this program of this process; None: nobody, or it is none."""
    to = cell.actor.lines_to if isinstance(cell.actor, Program) else None
    if to is None or to.startswith("/"):
        return to
    named = cell.node.names.get(to)
    return None if named is None else named.path


async def hear_lines(node: Node, heard: Callable[[str], None]) -> None:
    """Call `heard` with the program's address for each line that an actor is told; without end."""

    def listen(event: Event) -> None:
        if isinstance(event, LogLine):
            cell = node.find(event.address)
            if cell is not None and isinstance(cell.actor, Program) and cell.actor.lines_to is not None:
                heard(event.address)

    node.events.add_sink(listen)
    try:
        await asyncio.get_running_loop().create_future()
    finally:
        node.events.remove_sink(listen)
