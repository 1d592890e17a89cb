"""The recorder: takes in the events of a system, keeps them within bounds, and has the store keep them too."""

from __future__ import annotations

import os
from collections.abc import Callable
from heapq import merge
from typing import TYPE_CHECKING

from ...actors.events import ActorKilled, ActorStarted, ChildStopped, ChildTerminated, Event, LogLine, Restful
from ...actors.kernel.cell import RUNNING
from ...checkpoint.addresses import is_at
from ...supervision.children import WITH_SUPERVISOR
from ..last_lines.followers import Followers
from ..last_lines.line_memory import LineMemory
from .authors import author
from .counted_work import COUNTED, count_work
from .forgetting import telling_of
from .intake.alike_events import EVERY, AlikeCounter
from .lives import WITH_THE_SYSTEM, LivesByAddress
from .past_event import UNKEPT, PastEvent, Plain, plain_fields, shortened
from .tracks import BOUNDS, EventTrack, TrackName, track_of
from .writer import PACE, HistoryWriter, NoteStore, stored

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Iterator

    from ...actors.kernel.node import Node

MOST_EXPECTED = 1_000
"""Ends that somebody has called for and that have not come yet."""
FIRST_LIVES = 0.5
"""The part of a quota that is left to other events when many actors are started."""
ENDS = frozenset({ChildStopped, ChildTerminated})
RESTFUL: dict[TrackName, Restful] = {"others": "others", "letters": "letters"}
"""What need not be made while a track has had enough; rare events are told in any case."""


class HistoryRecorder:
    """Records the events of a node.

    Args:
        node: whose events they are.
        store: keeps the history over the end of the process; None: nothing does.
        log_payloads: record what was in messages, too.
        lines: keeps what processes print; None: one of its own.

    Attributes:
        keeps_payloads: whether it does.
        lives: what each address went through.
        lines: the last lines of the system, which are in no event of the history.
        followers: those who wait for the next event.
    """

    def __init__(
        self, node: Node, store: NoteStore | None, *, log_payloads: bool, lines: LineMemory | None = None
    ) -> None:
        self._node, self.keeps_payloads = node, log_payloads
        self.lives, self.lines = LivesByAddress(), lines or LineMemory(node.clock.wall)
        self._tracks = {name: EventTrack(bounds, node.loop.time()) for name, bounds in BOUNDS.items()}
        self._storm_since: float | None = None
        self._storm_timer: asyncio.TimerHandle | None = None
        self._alike = AlikeCounter()
        self._alike_timer: asyncio.TimerHandle | None = None
        self._expected: dict[str, tuple[str, str]] = {}
        self.followers = Followers()
        self._last = 0
        self._writer = None if store is None else HistoryWriter(node, store)
        self._load(store)
        node.events.record(self)

    def _load(self, store: NoteStore | None) -> None:
        """What earlier roots have recorded, and that this one begins."""
        known = [] if store is None else stored(store)
        for event in known:
            self._keep(event)
        why = "the process of the root ended"
        if known and known[-1].kind != "SystemStopped":
            why = "the process of the root was killed"
        self._note("SystemStarted", {"pid": os.getpid(), "why": why})

    # -- taking in --------------------------------------------------------------------------------------------------

    def __call__(self, event: Event) -> None:
        """Record an event, unless it is of no interest later, or there are too many."""
        if isinstance(event, LogLine):
            self.lines.add_printed(event.address, event.stream, event.text, event.life)
            return
        kind = type(event)
        if kind in UNKEPT or self._is_counted(event) or not self._admits(event, kind):
            return
        fields = plain_fields(event, payloads=self.keeps_payloads)
        if kind in ENDS and event.address in self._expected:
            by, because = self._expected.pop(event.address)
            fields["by"] = fields.get("by") or by
            fields["because"] = fields.get("because") or because
        if kind is ChildStopped and fields["because"] == WITH_SUPERVISOR and self._is_ending:
            fields["by"], fields["because"] = "", WITH_THE_SYSTEM
        if kind is ActorKilled:
            fields["by"] = fields["by"] or self._expected.get(event.address, (author(), ""))[0]
        if kind.__name__ in COUNTED:
            fields |= count_work(self._node, event.address)
        self._add(kind.__name__, event.address, fields)

    @property
    def _is_ending(self) -> bool:
        """Whether the whole system ends."""
        root = self._node.root
        return root is not None and root.state is not RUNNING

    def _is_counted(self, event: Event) -> bool:
        """Whether an event is one of many that are alike: a row says in a while how many there were."""
        now = self._node.loop.time()
        if not self._alike.counts(event, now):
            return False
        name = track_of(type(event).__name__)
        if not self._tracks[name].counts(now):
            self._rest(RESTFUL.get(name), now)
        if self._alike_timer is None:
            self._alike_timer = self._later(EVERY, self._tell_alike)
        return True

    def _tell_alike(self) -> None:
        self._alike_timer = None
        for kind, address, fields in self._alike.take_rows():
            self._add(kind, address, fields)

    def _admits(self, event: Event, kind: type[Event]) -> bool:
        now, name = self._node.loop.time(), track_of(kind.__name__)
        is_first = isinstance(event, ActorStarted) and event.life == 1
        is_admitted = self._tracks[name].admits(now, leaving=FIRST_LIVES if is_first else 0.0)
        if not is_admitted:
            self._rest("starts" if is_first else RESTFUL.get(name), now)
        return is_admitted

    def _rest(self, of: Restful | None, now: float) -> None:
        """Have no more of these events made, as long as nobody else wants them."""
        if self._storm_since is None and of != "starts":
            self._storm_since = now
        if of is not None:
            self._node.events.rest(of)
        if self._storm_timer is None:
            self._storm_timer = self._later(PACE, self._look)

    def _look(self) -> None:
        """Some more can be recorded; if the storm is over, say how long it was."""
        self._storm_timer = None
        self._node.events.wake()
        now = self._node.loop.time()
        if not all(track.is_quiet(now) for track in self._tracks.values()):
            self._storm_timer = self._later(PACE, self._look)
        elif self._storm_since is not None:
            seconds, self._storm_since = now - self._storm_since, None
            self._note("EventsLeftOut", {"seconds": seconds})

    def expect(self, address: str, by: str, because: str) -> None:
        """Somebody has called for the end of a life: when it comes, it is known who, and why."""
        self._expected.pop(address, None)
        self._expected[address] = by, because
        if len(self._expected) > MOST_EXPECTED:
            del self._expected[next(iter(self._expected))]

    def _note(self, kind: str, fields: dict[str, Plain]) -> None:
        """Record what is no event of the stream."""
        self._add(kind, f"/{self._node.name}", fields)

    def _add(self, kind: str, address: str, fields: dict[str, Plain]) -> None:
        event = PastEvent(self._last + 1, self._node.clock.wall(), kind, shortened(address), fields)
        self._keep(event)
        if self._writer is not None:
            self._writer.add(event)
        if self.followers:
            self.followers.tell()

    def _keep(self, event: PastEvent) -> None:
        self._last = max(self._last, event.number)
        self._tracks[track_of(event.kind)].ring.add(event)
        self.lives.apply(event)

    def _later(self, seconds: float, call: Callable[[], None]) -> asyncio.TimerHandle:
        """In nobody's name: whoever told the event may be an actor in its turn."""
        return self._node.loop.call_later(seconds, call, context=self._node.base_context.copy())

    def forget(self, top: str, dry_run: bool = False) -> int:
        """Forget the past of an address, and of those below it: how many events that were.

        Args:
            top: the address.
            dry_run: only count them.

        Raises:
            HoldfastError: the store refused; it may be tried again.
        """
        events = {event.number: event for event in self.after(-1)}
        if self._writer is not None:
            events.update((event.number, event) for event in self._writer.stored())
        numbers = telling_of(events.values(), top)
        if dry_run:
            return len(numbers)
        if self._writer is not None:
            self._writer.forget(lambda event: event.number in numbers)
        for track in self._tracks.values():
            track.ring.forget(lambda event: event.number in numbers)
        self._alike.forget(top)
        self.lives.forget(top)
        self.lines.forget(top)
        for path in [path for path in self._expected if is_at(path, top)]:
            del self._expected[path]
        return len(numbers)

    # -- giving out -------------------------------------------------------------------------------------------------

    @property
    def last(self) -> int:
        """The number of the newest event."""
        return self._last

    def after(self, number: int) -> Iterator[PastEvent]:
        """The events with larger numbers that are kept, oldest first."""
        found = (track.ring.after(number) for track in self._tracks.values())
        return merge(*found, key=lambda event: event.number)

    @property
    def is_in_storm(self) -> bool:
        """Whether events are left out at the moment because there are too many."""
        return self._storm_since is not None

    @property
    def oldest(self) -> int:
        """The smallest number of an event that is kept; 0 if there is none."""
        return min((track.ring.oldest for track in self._tracks.values() if track.ring.oldest), default=0)

    @property
    def dropped(self) -> int:
        """Events that have given way to newer ones."""
        return sum(track.ring.dropped for track in self._tracks.values())

    def close(self) -> None:
        """The system has ended: say so, and have the store keep what it does not have yet."""
        for timer in (self._storm_timer, self._alike_timer):
            if timer is not None:
                timer.cancel()
        self._tell_alike()
        self._note("SystemStopped", {"why": "the system stopped"})
        if self._writer is not None:
            self._writer.close()
        self.followers.close()
        self.lines.close()


def expect_end(recorder: HistoryRecorder | None, address: str, because: str) -> None:
    """Whoever calls this is about to end the life at an address: the history, if there is one, is to say so."""
    if recorder is not None:
        recorder.expect(address, author(), because)
