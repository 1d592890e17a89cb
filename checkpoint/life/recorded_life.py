"""The life of a recorded actor, wherever it is lived: one turn per input that its home feeds, each reported.

Replay is not a mode here: the home feeds what was handled before in the same order, and drops what it has released
already. Only time and randomness come from the input instead of the world.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import time
from collections.abc import Callable, Generator
from typing import TYPE_CHECKING, Any, Final, NoReturn, Protocol

from ...actors.control.trace_tail import follow
from ...actors.effects import EffectCall
from ...actors.errors import (
    ActorStopped,
    BadMessage,
    BadReply,
    ControlFailed,
    HoldfastError,
    StartFailed,
    UnknownMessage,
    remote_crash,
    type_name,
)
from ...actors.events import RecordsMapped
from ...actors.exit_reasons import ExitReason
from ...actors.kernel import lifecycle, links, mailbox
from ...actors.kernel.actor import Actor, Start
from ...actors.kernel.cell import DOWN, RUNNING, Cell
from ...actors.kernel.codec import known_at
from ...actors.kernel.envelope import Item
from ...actors.kernel.message import Message, message_name, reply_type
from ...actors.kernel.node import cell_kind
from ...actors.persistence import UNFIT
from ...actors.state_hooks import StateMismatch, state_getter
from ...actors.values import decode_value
from ..method import Method
from ..protocol import (
    FAILED,
    MESSAGE,
    MOMENT,
    NO_ANSWER,
    OK,
    REPLY,
    START,
    STASHED,
    STEPS,
    TICK,
    Answer,
    Feed,
    Glance,
    Go,
    Hooked,
    Ignored,
    Kept,
    LeavesTurn,
    Live,
    Out,
    Outcome,
    Perform,
    Released,
    Restore,
    Snapshot,
    SnapshotNow,
    Stranded,
    ToHome,
    ToLife,
    TurnEnd,
    Unreadable,
    Unsaved,
    Waits,
    pieces,
    untimed,
)
from ..snapshot.image_writer import Imaging
from ..snapshot.key_variables import check_keys, restore_state, save_state, variables
from ..turn_word import OVER, TurnWord
from .determinism_guard import DeterminismGuard
from .glances import answer_beside
from .life_state import Asked, Awaited, LifeStage, LifeTimers, LifeWaits, RestoredState, SnapshotState
from .outcome_order import OutcomeOrder, is_given_up
from .readonly_guard import check_readonly
from .recorded_context import Pending, RecordedContext, RecordedReplyHandle
from .recorded_inbox import INIT, STOP, Fed, GoLive, Hook, StopRecorded, TakeSnapshot, WorkFailed
from .replay_guard import digest_of

if TYPE_CHECKING:
    from ...actors.kernel.loop import Suspended
    from ...actors.values.saved_refs import SavedHandle
    from ..inputs import Input

NOT_SAVED: Final = -2
"""In place of the turn after which the last snapshot was made: none has the state as it is."""


class HomePort(Protocol):
    """The way from a life to its home."""

    def to_home(self, record: ToHome) -> None:
        """Hand a record to the home; it is handled in order."""
        ...

    def when_told(self, then: Callable[[], None]) -> None:
        """Call this when all that was handed over is on its way."""
        ...

    def closed(self) -> None:
        """Take down that the life is over."""
        ...


class Life:
    """One recorded life: the turn in hand, its outputs, and when the next snapshot is due."""

    begins = True  # what is handed to it, whenever it has come to that
    is_far = False

    def __init__(
        self, cell: Cell, port: HomePort, method: Method, page: memoryview | None, *, may_fork: bool = False
    ) -> None:
        self.cell, self.port, self.method = cell, port, method
        self.word = None if page is None else TurnWord(page)
        self.turn = 0
        self.feed: Feed | None = None
        self.outs: list[Out] = []
        self.last_k = 0
        self.waits = LifeWaits(OutcomeOrder(self))
        self.pipes = 0
        self.stash: list[Fed] = []
        self.returned: dict[int, Fed] = {}
        self.is_live = False
        self.hook = ""  # the hook that runs, if it is one that is no turn
        self.guard = DeterminismGuard() if method.strict else None
        self.restored = RestoredState()
        self.timers = LifeTimers()
        self.saving = SnapshotState()
        self.stage = LifeStage()
        self.images = Imaging(self, may_fork=may_fork)

    # -- beginning --------------------------------------------------------------------------------------------------

    def begin(self, start: Start[Any], turn: int, stash: list[int]) -> None:
        """Construct the actor and put its state back, if there is any; inputs may be fed from now on.

        Raises:
            StartFailed: `__init__` or the restoring raised.
        """
        cell = self.cell
        cell.life += 1
        if self.word is not None:
            self.word.clear()
        self.hook = INIT
        lifecycle.build(cell, start, self._context)
        self.hook = ""
        actor = cell.actor
        assert actor is not None
        self.turn = turn
        restored = self.restored
        if restored.traps:
            cell.extra().trap_exits = True
        try:
            check_keys(actor, self.method, first=not restored.has_state)
        except HoldfastError as error:
            self._give_up(str(error), error)
        self.saving.variables = variables(actor) if state_getter(actor) is None else []
        if self.method.check_readonly:
            check_readonly(actor, self)
        if restored.has_state:
            begin = time.perf_counter()
            try:
                data = self.images.mapped(restored.image) if restored.image is not None else restored.joined()
                self.images.last_bytes = len(data)
                dropped, restored.is_mapped = restore_state(
                    actor, data, (restored.variables, self.saving.variables), handles=self._take_handle
                )
            except BaseException as error:
                why = UNFIT if isinstance(error, StateMismatch) else "its state could not be restored"
                self._give_up(f"{why}: {error}", error)
            restored.seconds = time.perf_counter() - begin
            if dropped:
                said = f"{type_name(start.kind)} has no {', '.join(dropped)} any more: what was saved of it is dropped"
                cell.node.emit(RecordsMapped(cell.path, said))
            self.saving.turn = turn
            hooks = start.kind.on_recovered is not Actor.on_recovered and self._is_replayed_from_snapshots
            if hooks and isinstance(data, bytes):  # An image is not compared with what the hook leaves.
                self.saving.begun_with = turn, _digest(data)
        restored.stash_ids = frozenset(stash)
        cell.state = RUNNING
        if restored.has_state and start.kind.on_start is not Actor.on_start:
            mailbox.queue_of(cell).append(Hook(self, "on_start"))
        lifecycle.up(cell)

    def _context(self, cell: Cell) -> RecordedContext:
        """Made before `__init__` runs: that may use `ctx` already."""
        made = RecordedContext(cell)
        made.recorded = self
        return made

    def _give_up(self, why: str, error: BaseException) -> NoReturn:
        """The actor was constructed, and cannot begin."""
        cell = self.cell
        assert cell.ctx is not None
        cell.ctx._close()
        cell.actor = cell.ctx = None
        raise StartFailed(cell.path, why) from error

    # -- records from home ------------------------------------------------------------------------------------------

    def take(self, source: Input) -> None:
        """Take a new input from a home in this process: as it is, if a feed would not say more or less."""
        self._take(source if source.ask is None and not source.origin else source.feed())

    def to_life(self, record: ToLife) -> None:
        """Take what the home says, in order."""
        match record:
            case Feed():
                self._take(record)
            case Outcome():
                if record.taken >= 0:
                    self.drop_queued(record.taken)
                self.waits.order.take(record)
            case Perform():
                self._perform(record)
            case Stranded():
                place = frozenset({(record.turn, record.k)})
                self.waits.stranded = self.waits.stranded - place if record.is_over else self.waits.stranded | place
                self.cell.node.loop.call_soon(self.leave_waiting)
            case Glance():  # Not here and now: this may be called in a turn of the very actor.
                self.cell.node.loop.call_soon(answer_beside, self, record.feed)
            case Go():
                self._queue(GoLive(self, record))
            case SnapshotNow(urgent=True):
                self.want_snapshot()
            case SnapshotNow(at_once=True):
                self._queue(TakeSnapshot(self))
            case Kept():
                self.images.kept(record)
            case SnapshotNow():
                self.image_lost()  # The next one that is due is taken.
            case Restore():
                self.restored.take(record)
                self.timers.take(record.timers)
            case _:
                pass  # for whoever begins lives

    def _take(self, feed: Feed) -> None:
        cell = self.cell
        returned = self.returned.get(feed.id)  # until its turn begins: it may be taken from the queue again
        if returned is not None:
            fed = Fed(self, feed, returned.message, returned.sender, feed.chain)
        else:
            sender = None if feed.sender is None else cell.node.cell_at(feed.sender)
            fed = Fed(self, feed, None, sender, feed.chain)
        if feed.chain and feed.turn < 0:  # What is handled again is no new work.
            follow(fed)
        if feed.kind == TICK and feed.origin in self.timers.cancelled and feed.turn < 0:
            return  # Its timer was cancelled while it was on its way; the home drops it too.
        if not self.is_live and feed.turn < 0 and feed.id in self.restored.stash_ids:
            if self.restored.unstashes:
                self.returned[feed.id] = fed
            else:
                self.stash.append(fed)
            return
        self._queue(fed)

    def _queue(self, item: Item) -> None:
        cell = self.cell
        queue = cell.queue
        if queue is None:
            queue = mailbox.queue_of(cell)
        queue.append(item)
        if not cell.scheduled:
            cell.schedule()

    def hear(self, record: Outcome) -> bool:
        """Tell a turn the outcome of one of its outputs; False if it does not wait for that."""
        waits = self.waits
        waits.heard += 1
        if self.stage.begun >= 0:
            self._say_it_waits_in(STEPS)  # Behind the turn, if that has waited for this.
        future, awaited = waits.outcomes.get((record.turn, record.k), (None, None))
        if future is None or (is_given_up(record) and not future.done()):
            return False
        del waits.outcomes[record.turn, record.k]
        if future.done():
            waits.order.ignored(record)
            return False
        try:
            answer, when = untimed(record.answer)
            if when:
                future.when = when  # type: ignore[attr-defined]  # only what has a time is `Pending`
            if answer.kind in (REPLY, MESSAGE, MOMENT):
                future.set_result(self._result(answer, awaited))
            else:
                future.set_exception(self._error(answer, awaited))
        except Exception as error:
            if isinstance(awaited, EffectCall):  # It was read before it counted, so its class has changed since.
                why = f"what {awaited.key} has ended with: {error}"
                self.port.to_home(Unreadable(record.turn, record.k, why))
            else:
                future.set_exception(BadReply(*self._asked(awaited), str(error)))
        return True

    def _asked(self, awaited: Awaited) -> tuple[str, str]:
        """Who was to do what, as errors name it."""
        if isinstance(awaited, Asked):
            return awaited.actor, type_name(awaited.message)
        return self.cell.path, awaited.key if isinstance(awaited, EffectCall) else "what it has waited for"

    def _result(self, answer: Answer, awaited: Awaited) -> object:
        """What a turn gets that has waited."""
        if awaited is None or answer.kind == MOMENT:
            return None
        if isinstance(awaited, Asked):
            return self.cell.node.codec.decode_reply(awaited.message, answer.body)
        if isinstance(awaited, EffectCall):
            return decode_value(answer.body, refs=self.cell.node.ref_at)
        kind = next((kind for kind in awaited if message_name(kind) == answer.name), None)
        return self.cell.node.codec.decode(kind or self.cell.table.kind_named(answer.name), answer.body)

    def _error(self, answer: Answer, awaited: Awaited) -> HoldfastError:
        """What is raised where a turn has waited."""
        codec = self.cell.node.codec
        if isinstance(awaited, EffectCall):  # Its handler may know the very class.
            return codec.decode_own_error(answer.kind, answer.name, answer.body)
        return codec.decode_error(answer.kind, answer.name, answer.body, *self._asked(awaited))

    def _perform(self, order: Perform) -> None:
        """An effect of the turn in hand has no outcome yet."""
        outcome, effect = self.waits.outcomes.get((order.turn, order.k), (None, None))
        ctx = self.cell.ctx
        if isinstance(outcome, Pending) and isinstance(effect, EffectCall) and isinstance(ctx, RecordedContext):
            if outcome.done():
                return  # It was given up meanwhile.
            ctx.perform(order, effect, outcome)

    # -- turns ------------------------------------------------------------------------------------------------------

    def open_turn(self, feed: Feed) -> None:
        """A turn begins; a replayed one gets the number it had."""
        if feed.turn >= 0:
            self.turn = feed.turn
            kind: Any = type(self.cell.actor)
            if feed.kind != START or kind.on_start is not Actor.on_start:  # Else nothing is run again.
                self.stage.has_replayed = True
        else:
            self.turn += 1
        if self.returned:
            self.returned.pop(feed.id, None)  # It has come again: its feed may have been here before it was put back.
        if feed.spent or feed.kind == TICK:
            self.note_timers(feed)
        self.feed, self.last_k, self.stage.ending = feed, 0, None
        waits = self.waits
        waits.moment, waits.resting = 0.0, ()
        if waits.stranded:
            waits.stranded = frozenset()
        if waits.order.is_used:
            waits.order.begin()
        if self.outs:  # What a turn that was left in the middle has said does not count.
            self.outs = []
        if self.word is not None:
            self.word.begin(feed.id)

    def note_timers(self, feed: Feed) -> None:
        """The message of a timer has come, in this turn or in those before it that are left out."""
        for key in (*feed.spent, feed.origin) if feed.kind == TICK else feed.spent:
            self.timers.came(key)

    def mark(self, *, waits: bool) -> None:
        """Say on the page that the turn in hand is at work, or how it waits."""
        if self.word is not None and self.feed is not None:  # Else it is over, or its life was abandoned.
            self.word.mark(self.waits.how(self.turn) if waits else 0)

    @contextlib.contextmanager
    def work_beside(self, turn: int) -> Generator[None, None, None]:
        """What is done in here is work for this turn, while it waits."""
        waits = self.word is not None and self.feed is not None and turn == self.turn and self.word.how != 0
        if waits:
            self.mark(waits=False)
        try:
            yield
        finally:
            if waits and self.word is not None:
                self.word.mark(OVER if self.feed is None else self.waits.how(self.turn))

    def _say_it_waits_in(self, steps: int) -> None:
        """As `say_it_waits`, after so many steps of the loop, in which the turn may go on."""
        if steps:
            self.cell.node.loop.call_soon(self._say_it_waits_in, steps - 1)
        else:
            self.say_it_waits()

    def say_it_waits(self) -> None:
        """Say that the turn which had begun in an earlier life does not get on by itself, or does not begin."""
        if self.stage.begun >= 0 and self.is_live and not self.stage.is_over:
            self.port.to_home(Waits(self.waits.heard))

    def close_turn(self, status: str, answer: Answer) -> None:
        """A turn has ended: report it, with what it sent."""
        feed = self.feed
        if feed is None:
            return  # The life was abandoned in this very turn: what it says does not count.
        state = (
            digest_of(self.cell.actor)
            if self.method.check_replay and self.cell.actor and status in (OK, STASHED)
            else 0
        )
        if self.waits.outcomes:
            self.waits.order.end_turn()
        outs, self.feed, self.outs = self.outs, None, []
        ends = None if status == FAILED else self.stage.ending
        self.port.to_home(TurnEnd(self.turn, feed.id, status, outs, answer, state, ends))
        if self.word is not None:
            self.word.mark(OVER)
        self._settle(feed.id)
        if self.is_live and self.stage.begun >= 0:
            self.stage.begun = -1
            if self.returned:
                self.handle_returned()

    def _settle(self, number: int) -> None:
        """The turn of this input is over, or left where it rests: if it was owed, orders are obeyed from now on."""
        stage = self.stage
        if stage.owed == number:
            stage.owed = -1
            self._obey_postponed()

    def _obey_postponed(self) -> None:
        postponed, self.stage.postponed = self.stage.postponed, []
        for call in postponed:
            self.cell.urge(call)

    def end(self, reason: ExitReason, *, ends_itself: bool) -> None:
        """Have the actor stopped, as others would: by the turn in hand, or by a hook or a task beside it."""
        self.stage.ends_itself = ends_itself
        self.cell.request_stop(reason)
        self.stage.ends_itself = False

    def stop(self, reason: ExitReason) -> None:
        """End in good order: behind the turn in hand, or in the middle of one that rests, also if it does so only then.

        So it is in one that waits for an answer of somebody who has been stopped before. The next life goes on with
        that. There is no snapshot of such a moment, and `on_stop` is not called in it. A turn that ends the life itself
        comes to its own end: there may be no next life.
        """
        if self.cell.state is not RUNNING:
            return
        if self.stage.ends_itself:
            self.cell.urge(StopRecorded(self, reason))
            return
        turn = None if self.cell.more is None else self.cell.more.turn
        if self.waits.resting and turn is not None and turn.then is None:
            self._leave(turn, reason)
            return
        self.stage.stopping = reason
        self.cell.urge(StopRecorded(self, reason))
        self.port.to_home(LeavesTurn())
        self.leave_waiting()

    def leave_waiting(self) -> None:
        """End in the middle of the turn in hand, if the life is to end, and that rests or waits for who has ended."""
        reason, turn = self.stage.stopping, None if self.cell.more is None else self.cell.more.turn
        if reason is None or turn is None or turn.then is not None or turn.killed or self.feed is None:
            return
        if self.is_live and self.method.replays and (self.waits.resting or self.waits.are_stranded(self._has_nobody)):
            if self.word is not None:
                self.word.mark(OVER)  # No end of this life is due to the turn.
            self._leave(turn, reason)

    def _has_nobody(self, awaited: Awaited) -> bool:
        """Whether it is an answer of one of the runtime's actors in this process that is between two lives."""
        cell = self.cell.node.find(awaited.actor) if isinstance(awaited, Asked) else None
        kind = None if cell is None or cell.state is not DOWN else cell_kind(cell)
        return kind is not None and kind._is_asked_again

    def _leave(self, turn: Suspended, reason: ExitReason) -> None:
        self.feed, self.outs = None, []  # What its handler says while it is cancelled does not count.
        turn.then = functools.partial(self._end_left, reason)
        turn.runner.task.cancel()

    def _end_left(self, reason: ExitReason) -> None:
        """The turn is left. What follows is a step of its own: it may wait for children, and has another runner."""
        mailbox.queue_of(self.cell).appendleft(lifecycle.CutOff(reason))
        self.cell.node.make_ready(self.cell)

    def leave_turn(self) -> bool:
        """Leave the turn in hand for the next life, which runs it again from its start; False if it does not rest."""
        if not self.waits.may_be_left or self.feed is None or not self.is_live or not self.method.replays:
            return False
        number = self.feed.id
        self.feed, self.outs = None, []  # What its handler says while it is cancelled does not count.
        self.stage.is_adrift = True
        self._settle(number)
        return True

    def ignore(self, why: str) -> None:
        """The actor does not want to be started: turn 0 stays open for the next start."""
        self.feed, self.outs, self.stage.ignored_why = None, [], why
        self.enter(STOP)  # That is what is left.
        if self.word is not None:
            self.word.mark(OVER)
        self.port.to_home(Ignored(why))

    def has_result(self, k: int) -> bool:
        """Whether the background work that is output k of the turn in hand has its result: it is not begun again."""
        return self.feed is not None and k in self.feed.pipes

    def fail_turn(self, error: BaseException) -> None:
        """The turn raised: what it has not released is dropped, its asker gets the error."""
        feed = self.feed
        if feed is None:
            return
        self.outs = []
        self.enter(STOP)  # That is what is left.
        # The start of a protected actor tells it, and under replay it must not happen at all.
        is_heard = feed.is_ask or feed.kind == START or feed.turn >= 0
        self.close_turn(FAILED, self.answer_error(remote_crash(error)) if is_heard else NO_ANSWER)

    def answer_error(self, error: BaseException) -> Answer:
        """An error as the asker will get it."""
        asked = "what it was asked" if self.feed is None else self.feed.name.replace(":", ".")
        return Answer(*self.cell.node.codec.encode_error(error, known_at(self.cell), asked))

    def answer_reply(self, value: object, kind: type[Message[Any]]) -> Answer:
        """A reply to a message of this type as the asker will get it; one that cannot be coded becomes an error."""
        asked = type_name(kind)
        try:
            return self.answer_value(value, reply_type(kind), asked)
        except TypeError as error:  # A name in the type of the reply is not known in the module of the message.
            return self.answer_error(BadReply(known_at(self.cell), asked, str(error)))

    def answer_later(self, value: object, asked: str) -> Answer:
        """As `answer_reply`, to a message of this name; one that is not handled any more declares nothing."""
        try:
            kind = self.cell.table.kind_named(asked)
        except UnknownMessage:
            return self.answer_value(value, set, asked.replace(":", "."))  # As with Any, but sets are looked for.
        return self.answer_reply(value, kind)

    def answer_value(self, value: object, declared: Any, asked: str) -> Answer:
        """A reply to a message of type `asked` as the asker will get it; one that cannot be coded becomes an error."""
        try:
            return Answer(REPLY, "", self.cell.node.codec.encode_alike(value, self.cell.path, declared))
        except BadMessage as error:
            return self.answer_error(BadReply(known_at(self.cell), asked, error.problem))

    def put(
        self, verb: str, to: str, name: str = "", body: bytes = b"", *, seconds: float = 0.0, interval: float = 0.0
    ) -> int:
        """One more output of the turn in hand, or of the hook that runs; returns its number.

        What a hook does takes effect at once: a hook runs at each life, and is not replayed.
        """
        self.last_k = k = self.last_k + 1
        out = Out(k, verb, to, name, body, seconds, interval, self.stage.trace)
        if self.feed is None:
            self.port.to_home(Hooked(self.hook, out))
        else:
            self.outs.append(out)
            if self.waits.order.due:
                self.cell.node.loop.call_soon(self.waits.order.go_on)
        return k

    def enter(self, hook: str) -> None:
        """A hook begins that is no turn."""
        self.hook, self.last_k = hook, 0

    def leave(self) -> None:
        """The hook has returned."""
        self.hook = ""

    def timer_of_hook(self, name: str, body: bytes, interval: float) -> str:
        """The key of a timer that the hook which runs wants."""
        return self.timers.key_for((name, body, interval), f"{self.turn}{self.hook}")

    def cancel_timer(self, key: str) -> None:
        """Ticks that are queued here, or on their way, are dropped here and at home."""
        self.put("cancel", key)
        self.timers.cancelled.add(key)
        self.timers.drop(key)
        self._drop(lambda feed: feed.kind == TICK and feed.origin == key and feed.turn < 0)

    def drop_queued(self, number: int) -> None:
        """An input is none any more."""
        self._drop(lambda feed: feed.id == number)
        self._settle(number)

    def _drop(self, is_over: Callable[[Feed], bool]) -> None:
        """Forget inputs that are queued, and are none any more."""
        queue = mailbox.queue_of(self.cell)
        for index, item in enumerate(queue):  # Not removed: the run loop has counted them.
            if isinstance(item, Fed) and is_over(item.feed):
                queue[index] = mailbox.NOTHING

    def release(self) -> None:
        """What this turn has sent so far leaves now.

        Raises:
            ActorStopped: the life was killed in this turn, which will be handled again: what it says while it is
                cancelled, the next life will not say.
        """
        more = self.cell.more
        if more is not None and more.turn is not None and more.turn.killed:
            raise ActorStopped(self.cell.path, "this life was killed; it may not send any more")
        feed = self.feed
        if feed is not None and self.outs:
            self.port.to_home(Released(self.turn, feed.id, self.outs))
            self.outs = []

    def _take_handle(self, handle: SavedHandle) -> None:
        if isinstance(handle, RecordedReplyHandle):
            self.restored.promises.add(handle.id)

    # -- snapshots --------------------------------------------------------------------------------------------------

    def go_live(self, gone: tuple[int, ...]) -> None:
        """Take what is new, for the replay is over; what is `gone` was put aside under replay, and has ended since."""
        self.is_live, stage = True, self.stage
        self.stash = [fed for fed in self.stash if fed.feed.id not in gone]
        for key in gone:
            self.returned.pop(key, None)
        self._begun_first()
        if self.returned and stage.begun < 0:  # Unstashed under replay, and not handled before the crash.
            self.handle_returned()
        if stage.begins_suspended:  # Behind what comes first: it is not handled either.
            mailbox.suspend(self.cell)
        self.port.to_home(Live(self.restored.seconds, self.restored.take_promises()))
        if self.saving.is_due:
            self.want_snapshot()
        elif stage.has_replayed and self.method.snapshots:  # A crash loop must not replay the same turns for ever.
            self.port.when_told(self._snapshot_of_replay)  # The actor is released meanwhile.
        self._obey_postponed()
        if stage.stop_wanted is not None:
            self.cell.request_stop(stage.stop_wanted)

    def _begun_first(self) -> None:
        """What has sent something comes before all that hooks have put back, also if it was put back itself."""
        stage = self.stage
        first = self.returned.pop(stage.begun, None)
        if first is not None:
            first.feed.has_begun = True
            self.returned = {stage.begun: first} | self.returned
            stage.begun = -1

    def handle_returned(self) -> None:
        """Handle what was put aside and is put back, before anything else."""
        mailbox.queue_of(self.cell).extendleft(reversed(self.returned.values()))
        self.returned.clear()
        self.cell.schedule()

    def _snapshot_of_replay(self) -> None:
        if self.cell.actor is not None and not self.stage.is_over:
            self.want_snapshot()

    def want_snapshot(self) -> None:
        """Save the state before anything else is handled."""
        self.cell.urge(TakeSnapshot(self))

    def take_snapshot(self, *, is_last: bool = False) -> None:
        """Save the state after the last turn; while background work is out, its turn must stay in the journal."""
        if not self.method.snapshots or self.stage.is_adrift:
            return
        if self.pipes:
            self.saving.is_postponed = True
            return
        if not self.is_live or (self.turn == self.saving.turn and not (is_last and self.images.is_busy)):
            return
        actor = self.cell.actor
        assert actor is not None
        assert self.feed is None, "a state is saved between two turns, never in the middle of one"
        is_due, self.saving.is_due = self.saving.is_due, False
        begin = time.perf_counter()
        try:
            if not (is_last or is_due) and self.images.suits():  # An image comes when more was handled.
                self.images.take()
                return
            data = save_state(actor)
        except BaseException as error:  # What the user's own `get_state` raises is no reason to lose what it has.
            self.port.to_home(Unsaved(str(error)))
            return
        if is_due and self._is_as_begun(data):
            self.saving.turn = self.turn
            return
        self._send_snapshot(data, begin)

    @property
    def _is_replayed_from_snapshots(self) -> bool:
        return self.method.snapshots and self.method.replays

    def hook_changes(self) -> None:
        """A hook may change the state, and no replay leads to that: it is saved before anything else is handled."""
        if self._is_replayed_from_snapshots:
            self.saving.turn, self.saving.is_due = NOT_SAVED, True

    def _is_as_begun(self, data: bytes) -> bool:
        """Whether nothing was handled since the life began with a state, and its hook has not changed that."""
        if self.saving.begun_with != (self.turn, _digest(data)):
            return False
        return self.restored.stash_ids == {fed.feed.id for fed in self.stash}

    def pipe_back(self) -> None:
        """Background work has ended: a snapshot that had to wait for it can be taken."""
        self.pipes -= 1
        if self.saving.is_postponed and not self.pipes:
            self.saving.is_postponed = False
            self.want_snapshot()

    @property
    def traps(self) -> bool:
        """Whether EXIT signals come to `on_exit`."""
        more = self.cell.more
        return more is not None and more.trap_exits

    def image_taken(self, turn: int) -> None:
        """An image of the state after this turn is on its way."""
        self.saving.turn = turn

    def image_lost(self) -> None:
        """Its home could not keep the last one."""
        self.saving.turn = NOT_SAVED

    def work_failed(self, failed: WorkFailed) -> None:
        """A background task has raised. If a replay has begun it, that comes to its end first, whatever its pace."""
        if self.is_live:
            self.cell.push(failed)
        else:
            self.stage.postponed.append(failed)

    def save_before_crash(self) -> None:
        """The life ends by what no replay repeats: save what a replay would lead to, and begin the same work again."""
        if self._is_replayed_from_snapshots:
            self.take_snapshot(is_last=True)

    def last_snapshot(self) -> None:
        """Save the state for a life somewhere else.

        Raises:
            UnsavableValue, StateMismatch, what `get_state` raises: it cannot be saved.
        """
        actor = self.cell.actor
        assert actor is not None
        begin = time.perf_counter()
        if self.stage.is_adrift:
            return  # All is replayed up to the turn that was left.
        if self.method.snapshots and (self.turn != self.saving.turn or self.images.is_busy):  # Else all is replayed.
            self._send_snapshot(save_state(actor), begin)

    def may_replace(self) -> str:
        """Why the state cannot be replaced from outside now; "" if it can: a snapshot has to follow at once."""
        if not self.method.snapshots:
            return f"{self.method.name} takes no snapshots, and no replay leads to a state that was put in place"
        return "background work (pipe_to_self) is out; try again when it is back" if self.pipes else ""

    def replaced(self) -> None:
        """The state was replaced from outside, in no turn: only a snapshot can bring it back.

        Raises:
            UnsavableValue, StateMismatch, what `get_state` raises: it cannot be saved.
        """
        told = self.replaced_snapshot()
        self._begin_snapshot(sum(len(piece.data) for piece in told))
        for piece in told:
            self.port.to_home(piece)
        if self.saving.turn != self.turn:  # A home in another process says so later, and ends this life.
            raise ControlFailed(self.cell.path, "replace_state", "the new state could not be saved")

    def replaced_snapshot(self) -> list[Snapshot]:
        """The present state as the home would be told of it, piece by piece."""
        actor, begin = self.cell.actor, time.perf_counter()
        assert actor is not None
        return self._snapshot(save_state(actor), begin, is_replaced=True)

    def _send_snapshot(self, data: bytes, begin: float) -> None:
        self._begin_snapshot(len(data))
        for piece in self._snapshot(data, begin, is_replaced=False):
            self.port.to_home(piece)

    def _begin_snapshot(self, size: int) -> None:
        self.images.stop()
        self.images.restart()
        self.images.last_bytes = size
        self.saving.turn = self.turn  # Before it is sent: a home in this process says at once if it cannot keep it.

    def _snapshot(self, data: bytes, begin: float, *, is_replaced: bool) -> list[Snapshot]:
        stash = [fed.feed.id for fed in self.stash]
        pause = time.perf_counter() - begin
        parts = pieces(data)
        said = self.traps, *self.made_by()
        last = len(parts) - 1
        return [
            Snapshot(self.turn, part, index == last, stash, pause, is_replaced, None, *said)
            for index, part in enumerate(parts)
        ]

    def made_by(self) -> tuple[str, list[str]]:
        """The class whose state is saved, and the variables that it had when `__init__` had run."""
        actor = self.cell.actor
        return ("", []) if actor is None else (message_name(type(actor)), self.saving.variables)

    def close(self) -> None:
        """End what the life has out, for it is over."""
        self.stage.is_over = True
        self.images.close()
        self.waits.order.close()
        for future, _ in self.waits.outcomes.values():
            future.cancel()
        self.waits.outcomes.clear()
        for call in self.stage.postponed:  # The next life's.
            self.cell.urge(call)
        self.port.closed()
        self.feed, self.outs = None, []  # A turn that swallows its cancellation cannot speak for the next life.


def _digest(data: bytes) -> bytes:
    return hashlib.blake2b(data, digest_size=16).digest()


class LifePlace(lifecycle.HerePlace):
    """The event loop of this process, for a recorded actor: its home feeds its turns."""

    def __init__(self, life: Life | None = None) -> None:
        self.life = life

    def stop(self, cell: Cell, reason: ExitReason) -> None:
        if self.life is not None:
            self.life.stop(reason)


class FedHome(lifecycle.MailboxHome):
    """What the actor's home at the root has fed to the life in this process."""

    def push(self, cell: Cell, item: Item) -> None:
        """What comes from others is an input: of the end of an actor in this process, too, the root tells the home."""
        if not isinstance(item, (links.Exit, links.Down)):
            super().push(cell, item)

    def recovers(self, reason: ExitReason) -> bool:
        return not reason.is_clean


FED = FedHome()
