"""A life of the protected actor inside a replica, and the items of its mailbox besides inputs."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Callable, Collection, Coroutine
from typing import TYPE_CHECKING, Any, Final, TypeVar

from ...actors.kernel.cell import Cell
from ...actors.kernel.envelope import Item
from ...actors.kernel.ref import ActorRef
from ...checkpoint.life.recorded_context import RecordedContext
from ...checkpoint.life.recorded_inbox import RECOVERED, STARTED, Fed, Hook, WorkFailed
from ...checkpoint.life.recorded_life import Life
from ...checkpoint.method import Method
from ...checkpoint.protocol import FAILED, Answer, Feed, Out, ToHome, TurnEnd

if TYPE_CHECKING:
    from .protected_actor import Server


T = TypeVar("T")

# Why the server came to rest.
OVER, BLOCKED, ENDED, ABANDONED, UNDONE = "over", "blocked", "ended", "abandoned", "undone"


class Rest:
    """Coming to rest: whoever has given something to the life waits until that is done, or cannot go on."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._number = 0  # of what was given last
        self._missed: str | None = None  # it has come to rest while nobody waited
        self._waiting: asyncio.Future[str] | None = None

    @property
    def is_awaited(self) -> bool:
        """Whether somebody waits for it."""
        return self._waiting is not None

    @property
    def missed(self) -> str | None:
        """Why it has come to rest while nobody waited; None if it has not."""
        return self._missed

    def next_number(self) -> int:
        """Return the number of what is given now; what was given before is of no concern any more."""
        self._number += 1
        return self._number

    def wait(self) -> asyncio.Future[str]:
        """Wait for what is given now."""
        self._missed = None
        return self.wait_on()

    def wait_on(self) -> asyncio.Future[str]:
        """Wait on for what was given before; that may have come to rest while nobody waited."""
        waiting: asyncio.Future[str] = self._loop.create_future()
        missed, self._missed = self._missed, None
        if missed is not None:
            waiting.set_result(missed)
        else:
            self._waiting = waiting
        return waiting

    def reach(self, why: str) -> None:
        """What was given is done, or cannot go on."""
        waiting, self._waiting = self._waiting, None
        if waiting is None:
            self._missed = why
        elif not waiting.done():
            waiting.set_result(why)

    def end(self, number: int) -> None:
        """All of what was given with this number is done; if that was to an earlier life, nobody wants to know."""
        if number == self._number:
            self.reach(OVER)


class ServerContext(RecordedContext):
    """`self.ctx` of the protected actor: it knows itself by the address that is protected, on every replica."""

    __slots__ = ("_server",)

    def __init__(self, cell: Cell, server: Server) -> None:
        super().__init__(cell)
        self._server = server
        self.readdress()

    def readdress(self) -> None:
        """Have the receivers of what its hooks send at once see the address that is protected now."""
        self._speaker = self._cell.node.cell_at(self.path)

    @property
    def path(self) -> str:
        return self._server.address

    @property
    def ref(self) -> ActorRef[Any]:
        return self._cell.node.cell_at(self.path).ref

    def create_task(self, work: Coroutine[Any, Any, T]) -> asyncio.Task[T]:
        if self._server.only_computes:  # The run that counts has begun it too: the actor does not end of this one.
            task = self._beside(work, "task")
            task.add_done_callback(_seen)
            return task
        self._server.begins_task()
        return super().create_task(work)

    def waits_for_room(self, topic: str) -> bool:
        """What is published leaves when the turn's result has been compared, voted on or copied, and not before."""
        return False


def _seen(task: asyncio.Task[Any]) -> None:
    if not task.cancelled():
        task.exception()


class ServerLife(Life):
    """A life of the protected actor. What it wants released in the middle of a turn is the server's to decide."""

    def __init__(self, cell: Cell, server: Server, method: Method) -> None:
        super().__init__(cell, server, method, None)
        self.server = server
        self.ended: Feed | None = None  # what the last turn has handled
        self.let_out: list[Out] = []  # of the turn in hand, beside `outs`: it has left, or is held back
        self.begun_names: set[str] = set()  # the variables of the actor when `__init__` had run
        self.is_touched = False  # by its hooks, since the point at which it has begun
        self.spoiled: Exception | None = None  # its hooks have left what is no state: why
        self.has_begun_tasks = False  # in turns since the last point
        self.saving.is_needed = server.state.has_access

    def _context(self, cell: Cell) -> RecordedContext:
        made = self._context_made = ServerContext(cell, self.server)
        made.recorded = self
        return made

    def readdress(self) -> None:
        """The actor is protected under another address."""
        self._context_made.readdress()

    def only_rests(self, stranded: Collection[int]) -> bool:
        """Whether the turn in hand waits for moments, messages or these asks, and nothing else of this life is out."""
        waits = self.waits
        out = [k for (_, k), (future, _) in waits.outcomes.items() if not future.done()]
        resting = len(waits.resting) + sum(k in stranded for k in out)
        return 0 < resting == len(out) and not (self.pipes or self.has_begun_tasks)

    def rewind(self, turn: int, stash: list[Fed], returned: dict[int, Fed]) -> None:
        """Go on from after an earlier turn: what was run since is run again, or something else is."""
        self.turn, self.stash, self.returned = turn, stash, returned
        self._context_made.draw_anew()

    def enter(self, hook: str) -> None:
        super().enter(hook)
        self.is_touched |= hook in (STARTED, RECOVERED)

    def leave(self) -> None:
        is_start = self.hook == STARTED
        super().leave()
        if is_start:
            self.server.take_in_hooks(self)

    def go_live(self, gone: tuple[int, ...]) -> None:
        super().go_live(gone)
        self.server.take_in_hooks(self)

    def open_turn(self, feed: Feed) -> None:
        super().open_turn(feed)
        self.let_out = []

    def close_turn(self, status: str, answer: Answer) -> None:
        """All that the turn has sent goes with its end: what left before may have been lost with whoever led then."""
        self.ended = self.feed
        if status != FAILED:
            self.outs = self.let_out + self.outs
        super().close_turn(status, answer)

    def handle_returned(self) -> None:
        """They are requests again, the first of the next part: any of them may have to stand at the front."""
        self.server.puts_back(self)

    def has_result(self, k: int) -> bool:
        return super().has_result(k) or (self.turn, k) in self.server.traces.results

    def release(self) -> None:
        if self.feed is not None and self.outs:
            self.server.wants_out(self)

    def release_now(self) -> None:
        """What the turn in hand has sent leaves."""
        outs = self.outs
        super().release()
        self.let_out += outs

    def hold_back(self) -> None:
        """What the turn in hand has sent does not leave before its end."""
        self.let_out += self.outs
        self.outs = []

    def take_again(self, held: list[Out]) -> None:
        """The turn in hand wants to send what was held back last."""
        del self.let_out[-len(held) :]
        self.outs = held + self.outs

    def take_snapshot(self, *, is_last: bool = False) -> None:
        """Asked for by the end in good order; others are made of points."""
        if is_last:
            self.server.last_snapshot()

    def work_failed(self, failed: WorkFailed) -> None:
        """Each replica ends at a time of its own, and begins with a point, or with what is recorded."""
        self.cell.push(failed)

    def save_before_crash(self) -> None:
        """Points are made by the server, between requests."""

    def want_snapshot(self) -> None:
        self.server.want_snapshot()

    def pipe_back(self) -> None:
        super().pipe_back()
        if not self.pipes:
            self.server.work_back()


class Nowhere:
    """The way home of a life that does not count any more."""

    def to_home(self, record: ToHome) -> None:
        """A record that nobody hears."""

    def when_told(self, then: Callable[[], None]) -> None:
        """There is nobody to tell."""

    def closed(self) -> None:
        """The end of a life that nobody waits for."""


NOWHERE: Final = Nowhere()


class PartOver(Item):
    """Stands behind what the server was given: it has come to rest, between two turns."""

    __slots__ = ("number", "rest")

    def __init__(self, rest: Rest) -> None:
        self.rest, self.number = rest, rest.next_number()

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        item.rest.end(item.number)
        return None


class Skip(Item):
    """In place of a turn that has failed: its number is used, and it has left nothing else."""

    __slots__ = ("end", "feed", "life")

    def __init__(self, life: ServerLife, feed: Feed, end: TurnEnd) -> None:
        self.life, self.feed, self.end = life, feed, end

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        life: ServerLife = item.life
        life.turn += 1
        life.note_timers(item.feed)
        end: TurnEnd = item.end
        life.returned.pop(end.id, None)  # It may have been put back before: it is handled with that.
        life.port.to_home(TurnEnd(life.turn, end.id, end.status, [], end.answer, end.state, end.ends))
        return None


class BeginAgain(Hook):
    """`on_start` of a life that begins anew without its state, because nobody can save that."""

    __slots__ = ()

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        item.life.enter(STARTED)
        result = actor.on_start(False)
        if inspect.iscoroutine(result):
            return item.finish(result)
        item.over()
        return None
