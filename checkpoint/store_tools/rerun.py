"""Recorded turns of one actor lived again, apart from everything else: the code may be another one than that of before.

The life is a real one, but no home lets its outputs out: they are compared with what is recorded, and go nowhere. What
a turn waits for comes from the journal or not at all, and nothing begins that was not handled before: no message that
waits, no timer, no effect, no background work. Hooks that every life calls before its first turn (`__init__`, and
`on_start` behind a snapshot) are called here too; what they tell others goes nowhere.
"""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple, NoReturn, TypeVar, cast

from ...actors.effects import EffectCall
from ...actors.errors import HoldfastError, ReplayDiverged
from ...actors.kernel.actor import Actor, Start
from ...actors.kernel.address_host import AddressHost
from ...actors.kernel.cell import DOWN, GONE, Cell
from ...actors.kernel.lifecycle import GRACE, LOCAL, NEAR
from ...actors.kernel.message import Message
from ...actors.kernel.ref import ActorRef
from ..home.homes import Homes
from ..home.pending_asks import ACCEPTED
from ..home.replay import is_as_before, is_same_reply
from ..inputs import Turn
from ..journal import Saved
from ..life.recorded_context import RecordedContext
from ..life.recorded_life import FED, Life, LifePlace
from ..method import Method
from ..protocol import AWAITED, FAILED, Answer, Feed, Out, Outcome, Released, ToHome, TurnEnd, Unreadable
from ..snapshot.snapshot_record import take_over

if TYPE_CHECKING:
    from ..home.input_ledger import InputLedger

A = TypeVar("A", bound=Actor)
R = TypeVar("R")

TOGETHER: Final = 1000
"""So many turns are fed at a time."""


class Recipe(NamedTuple):
    """How an actor is started by the code at hand; `bindings` are addresses by port."""

    start: Start[Any]
    method: Method
    bindings: Mapping[str, str]


class LifeEnded(HoldfastError, text="the life of {actor} has ended: {why}"):
    """The life has ended before its turns had."""

    actor: str
    why: str


class NotRecorded(HoldfastError, text="{hook} of {actor} waits for {what}, of which no outcome is recorded"):
    """A hook wants something of others, and only what turns have got is recorded."""

    actor: str
    hook: str
    what: str


class RerunContext(RecordedContext):
    """`self.ctx` of a life that nothing gets out of."""

    __slots__ = ()

    def _refuse(self, what: str) -> NoReturn:
        """Refuse what a hook waits for."""
        self._outside()
        life = cast("RerunLife", self.recorded)
        life.refused = NotRecorded(self.path, life.hook, what)
        raise life.refused

    def _tell(self, cell: Cell, message: Message[Any]) -> None:
        if self._in_turn():
            super()._tell(cell, message)
        else:
            self._outside()

    async def _send(self, cell: Cell, message: Message[Any]) -> None:
        if self._in_turn():
            await super()._send(cell, message)
        else:
            self._outside()

    async def publish(self, topic: str, message: Message[Any]) -> None:
        if self._in_turn():
            await super().publish(topic, message)
        else:
            self._outside()

    def _ask(self, cell: Cell, message: Message[R], timeout: float) -> asyncio.Future[R]:
        return super()._ask(cell, message, timeout) if self._in_turn() else self._refuse(f"the answer of {cell.path}")

    def _performed(self, effect: EffectCall) -> asyncio.Future[object]:
        return super()._performed(effect) if self._in_turn() else self._refuse(f"effect {effect.key}")

    def _slept(self, seconds: float, *, is_moment: bool) -> asyncio.Future[None]:
        return super()._slept(seconds, is_moment=is_moment) if self._in_turn() else self._refuse("a moment")

    def pipe_to_self(
        self,
        work: Awaitable[Any],
        then: Callable[[Any], Message[Any]],
        failed: Callable[[BaseException], Message[Any]] | None = None,
    ) -> None:
        if self._in_turn():
            super().pipe_to_self(work, then, failed)
            return
        self._outside()
        if asyncio.iscoroutine(work):
            work.close()

    def spawn(self, start: Start[A], name: str | None = None) -> ActorRef[A]:
        node = self._cell.node
        return cast(
            "ActorRef[A]", node.cell_at(f"{self.path}/{name or self._made_up_name() or node.numbers.next_name()}").ref
        )


class RerunLife(Life):
    """A life that begins nothing of its own, and tells of each turn that begins."""

    refused: NotRecorded | None = None
    raised: BaseException | None = None
    on_turn: Callable[[int, Feed], None]

    def _context(self, cell: Cell) -> RecordedContext:
        made = RerunContext(cell)
        made.recorded = self
        return made

    def has_result(self, k: int) -> bool:
        """Whether background work is not begun: never again."""
        return True

    def open_turn(self, feed: Feed) -> None:
        super().open_turn(feed)
        self.on_turn(self.turn, feed)

    def fail_turn(self, error: BaseException) -> None:
        self.raised = error
        super().fail_turn(error)


class Rerun:
    """One life of an address, from what a store has kept.

    Attributes:
        ledger: what is recorded.
        outs: the outputs of the turn in hand, or of the last one.
        end: how the last turn has ended.
        turn: the number of the turn in hand, or of the last one; -1: none has begun.
        feed: its input.
    """

    def __init__(
        self,
        homes: Homes,
        path: str,
        recipe: Recipe,
        saved: Saved,
        on_turn: Callable[[int, Feed], None] = lambda turn, feed: None,
    ) -> None:
        node = self._node = homes.node
        cell = self._cell = Cell(node, None, path, LOCAL)
        more = cell.extra()
        more.start = recipe.start
        more.bindings.update((port, node.cell_at(target)) for port, target in recipe.bindings.items())
        self._switch = homes.made(cell, recipe.method, saved)
        self._switch.timers.pause()
        self.ledger: InputLedger = self._switch.ledger
        self.outs: list[Out] = []
        self.end: TurnEnd | None = None
        self.turn = -1
        self.feed: Feed | None = None
        self._is_as_before = functools.partial(is_as_before, self._switch)
        self._seen = self._wanted = (
            0  # how many outputs of the turn in hand have come again, and how many are known if it has no end
        )
        self._last = -1  # with the end of this turn those that were fed are over
        self._failure: HoldfastError | None = None
        self._over: asyncio.Future[None] = node.loop.create_future()
        self._on_turn = on_turn
        self._life = RerunLife(cell, self, recipe.method, None)
        self._life.on_turn = self._begun
        cell.host = AddressHost(FED, LifePlace(self._life), NEAR)

    @property
    def actor(self) -> Actor:
        """The actor as it is now."""
        actor = self._cell.actor
        assert actor is not None
        return actor

    @property
    def turns(self) -> list[tuple[int, Turn]]:
        """The turns to be lived again; those that had failed have left nothing behind."""
        return self.ledger.replayed(())

    def begin(self) -> None:
        """Construct the actor, and put its state back.

        Raises:
            StartFailed: the code does not fit what is recorded, or `__init__` or the restoring raised.
        """
        switch, life = self._switch, self._life
        switch.shapes.check(self._cell)
        take_over(switch)
        for record in switch.restore_records():
            life.to_life(record)
        start = self._cell.extra().start
        assert start is not None
        life.begin(start, self.ledger.state_turn, self.ledger.stash)
        for key in self.ledger.stash:
            if key in self.ledger.open:
                life.to_life(self.ledger.open[key].feed())

    async def live(self, turns: Sequence[tuple[int, Turn]]) -> None:
        """Have these turns, which are the next ones, handled again.

        Raises:
            ReplayDiverged: one has gone another way. NotRecorded, LifeEnded: the life has ended before.
        """
        for first in range(0, len(turns), TOGETHER):
            some = turns[first : first + TOGETHER]
            self._expect(some[-1][0])
            for number, turn in some:
                self._life.to_life(turn.input.feed(number, was_asked=turn.reply != 0))
            await self._over

    async def live_begun(self) -> bool:
        """Have the turn that had begun go as far as it had come; False if there is none, or nothing is known of it.

        Raises:
            ReplayDiverged, LifeEnded: as `live`.
        """
        source = self.ledger.open.get(self.ledger.begun)
        if source is None or not self.ledger.released:
            return False
        self._life.restored.stash_ids = frozenset()  # It may have been put aside before.
        self._life.turn = self.ledger.turn  # Turns that had failed have used their numbers.
        self._wanted = len(self.ledger.released)
        self._expect(self.ledger.turn + 1)
        self._life.to_life(source.feed(has_begun=True))
        await self._over
        return True

    def _expect(self, last: int) -> None:
        if self._failure is not None:
            raise self._failure
        self._last, self._over = last, self._node.loop.create_future()

    def unreadable(self) -> str:
        """Why something that waits to be handled could not be; "" if all could."""
        for source in self.ledger.open.values():
            if source.name:
                try:
                    self._node.codec.message_in(self._cell, source.name, source.body)
                except HoldfastError as error:
                    return f"{source.name} waits to be handled, and could not be: {error}"
        return ""

    async def close(self) -> None:
        """End the life, without any hook."""
        self._failure = self._failure or LifeEnded(self._cell.path, "it is not wanted any more")
        if self._cell.state not in (DOWN, GONE):
            self._cell.kill()
            async with asyncio.timeout(2 * GRACE):
                await self._cell.ended()
        self._switch.images.close()

    # -- what the life says (`HomePort`) ------------------------------------------------------------------------------

    def to_home(self, record: ToHome) -> None:
        """Compare what a turn says; what hooks do, and snapshots, are dropped."""
        if self._failure is not None:
            return
        try:
            match record:
                case TurnEnd():
                    self._ended(record)
                case Released():
                    self._sent(record.turn, record.id, record.outs)
                case Unreadable():
                    raise ReplayDiverged(self._cell.path, record.turn, record.k, record.problem)
                case _:
                    pass
        except ReplayDiverged as error:
            self._fail(error)
            self._cell.kill()  # What follows in its queue is no concern of a life that went another way.

    def when_told(self, then: Callable[[], None]) -> None:
        """Nothing is on its way."""
        then()

    def closed(self) -> None:
        """Tell whoever waits for a turn that the life is over."""
        self._fail(self._life.refused or LifeEnded(self._cell.path, str(self._cell.extra().reason)))

    def _fail(self, error: HoldfastError) -> None:
        self._failure = self._failure or error
        if not self._over.done():
            self._over.set_exception(self._failure)
            self._over.exception()  # Perhaps nobody waits yet.

    def _sent(self, turn: int, key: int, outs: list[Out]) -> None:
        """Compare outputs; what was awaited before gets what it got then."""
        ledger = self.ledger
        self.outs += outs
        again = ledger.compare_outputs(turn, key, outs, self._is_as_before)
        self._seen += again
        for out in outs[:again]:
            if out.verb in AWAITED:
                answer = ledger.outcomes.get((turn, out.k))
                if answer is None and out.verb in ("send", "publish"):
                    answer = ACCEPTED
                if answer is not None:
                    self._life.to_life(Outcome(turn, out.k, answer, -1, ledger.digest_of(turn, out.k)))
        if turn > ledger.turn and self._seen >= self._wanted:
            self._done()  # It has come as far as it had.

    def _ended(self, end: TurnEnd) -> None:
        ledger = self.ledger
        self.end = end
        if end.outs:
            self._sent(end.turn, end.id, end.outs)
        if end.turn <= ledger.turn:
            ledger.judge_replay(end, self._seen, self.said, functools.partial(is_same_reply, self._switch))
        elif self._seen < self._wanted:
            cause = f"it raised {self._life.raised!r}" if end.status == FAILED else ""
            raise ReplayDiverged(self._cell.path, end.turn, self._seen + 1, cause)
        if end.turn >= self._last:
            self._done()

    def said(self, answer: Answer) -> str:
        """An error that a turn has ended with, in words."""
        return str(self._node.codec.decode_error(answer.kind, answer.name, answer.body))

    def _begun(self, turn: int, feed: Feed) -> None:
        self.turn, self.feed, self.end = turn, feed, None
        self.outs, self._seen = [], 0
        self._on_turn(turn, feed)

    def _done(self) -> None:
        if not self._over.done():
            self._over.set_result(None)
