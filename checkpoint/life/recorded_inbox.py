"""The mailbox items of a recorded life: its inputs, and the commands of its home."""

from __future__ import annotations

import types
from typing import TYPE_CHECKING, Any

import msgspec

from ...actors.errors import HoldfastError, RemoteCrash, StartFailed
from ...actors.exit_reasons import NORMAL, ExitReason, recorded_exit
from ...actors.kernel import lifecycle
from ...actors.kernel.actor import Actor
from ...actors.kernel.cell import Cell
from ...actors.kernel.context import Piped
from ...actors.kernel.envelope import LEAVE, Chain, Item, ReplyHandle
from ...actors.kernel.message import Refusal
from ..protocol import CRASH, DROPPED, LATER, NO_ANSWER, OK, START, STASHED, Answer, Feed, Go
from ..snapshot.key_variables import check_saved

if TYPE_CHECKING:
    from ...actors.kernel.node import Node
    from .recorded_life import Life

Coroutine_ = types.CoroutineType
INIT, STARTED, RECOVERED, STOP = "init", "start", "recovered", "stop"
"""The hooks that are no turns: `__init__`, `on_start(True)`, `on_recovered`, `on_stop`."""


class Fed(Item, msgspec.Struct, eq=False):
    """An input in the mailbox of its life. (A struct, as an envelope is: there is one for each message.)"""

    life: Any  # the `Life` that is to handle it
    feed: Feed
    message: Any  # None: it is still encoded, or brings none
    sender: Any  # the sending actor's Cell; None from outside
    chain: Chain
    is_stashed: bool = False

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        life: Life = item.life
        feed: Feed = item.feed
        life.open_turn(feed)
        if feed.deadline and feed.turn < 0 and not feed.has_begun and life.cell.node.clock.is_past(feed.deadline):
            life.close_turn(DROPPED, NO_ANSWER)  # Nobody waits any more.
            return None
        if item.message is None and feed.name:
            cell = life.cell
            try:
                item.message = cell.node.codec.message_for(cell, feed.name, feed.body)
            except HoldfastError as error:  # It came encoded, and is none of ours.
                life.close_turn(DROPPED, life.answer_error(error))
                return None
        try:
            result: Any = item.call(actor) if life.guard is None else life.guard.call(item.call, actor)
        except Refusal as no:
            item.refuse(no)
            return None
        if type(result) is Coroutine_:
            if life.guard is not None:
                result = life.guard.drive(result)
            return item.finish(result)
        item.end(item.answer(result) if feed.is_ask else NO_ANSWER)
        return None

    @property
    def is_ask(self) -> bool:  # type: ignore[override]  # as with the chain
        """Whether somebody waits for an answer."""
        return self.feed.is_ask

    def brings(self) -> str:
        return self.feed.name.replace(":", ".")

    def hook(self) -> str:
        return f"on_{self.feed.kind}" if self.feed.kind in ("start", "exit", "down") else self.feed.kind

    def call(self, actor: Any) -> Any:
        """Call the handler or hook that this input is for."""
        message = self.message
        return self._call_hook(actor) if message is None else actor._table[type(message)](actor, message)

    def _call_hook(self, actor: Any) -> Any:
        """What brings no message is for a hook, or is what background work has raised."""
        feed = self.feed
        node: Node = self.life.cell.node
        match feed.kind:
            case "start":
                return actor.on_start(False)
            case "exit":
                data = node.codec.decode(dict[str, Any], feed.body)
                reason, more = recorded_exit(data["reason"]), self.life.cell.more
                if more is not None and more.trap_exits:
                    return actor.on_exit(node.cell_at(data["source"]).ref, reason)
                if reason != NORMAL:
                    self.life.stage.is_cut_off = True
                    actor.ctx.stop(reason)
                return None
            case "down":
                data = node.codec.decode(dict[str, Any], feed.body)
                return actor.on_down(
                    node.cell_at(data["source"]).ref, recorded_exit(data["reason"]), bool(data["recovering"])
                )
            case _:
                error = node.codec.decode_error(CRASH, "", feed.body)
                assert isinstance(error, RemoteCrash)
                raise error

    async def finish(self, handler: Any) -> None:
        """The turn of an async handler."""
        try:
            result = await handler
        except Refusal as no:
            self.refuse(no)
        else:
            self.end(self.answer(result) if self.feed.is_ask else NO_ANSWER)

    def refuse(self, no: Refusal) -> None:
        """The handler said no, which is an answer; nobody has asked an actor to start."""
        if self.feed.kind == START:
            raise StartFailed(self.life.cell.path, str(no)) from no
        self.end(self.life.answer_error(no) if self.feed.is_ask else NO_ANSWER)

    def answer(self, result: object) -> Answer:
        """What the handler has returned, as whoever has asked gets it."""
        if isinstance(result, ReplyHandle):
            return Answer(LATER)
        answer: Answer = self.life.answer_reply(result, type(self.message))
        return answer

    def end(self, answer: Answer) -> None:
        """The turn is over; a stashed message stays open."""
        life = self.life
        if self.feed.kind == START and self.feed.turn < 0 and life.cell.actor is not None and life.saving.is_needed:
            check_saved(life.cell.actor, life.method)  # What cannot be saved is refused now, not when it is needed.
        if self.is_stashed:
            life.close_turn(STASHED, NO_ANSWER)
        else:
            life.close_turn(OK, answer)

    def is_start(self) -> bool:
        return self.feed.kind == START

    def ignored(self, cell: Cell, why: str) -> bool:
        """Called when the turn raised `Ignore`: only `on_start` may mean it."""
        if self.feed.kind == START:
            self.life.ignore(why)
        return self.feed.kind == START

    def fail(self, error: BaseException) -> None:
        """Called when the turn crashed the actor."""
        self.life.fail_turn(error.__cause__ or error)


class Hook(Item):
    """A hook that is no turn: called at each life, what it does takes effect at once and is not replayed."""

    __slots__ = ("life", "name")

    def __init__(self, life: Life, name: str) -> None:
        self.life, self.name = life, name

    def hook(self) -> str:
        return self.name

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        life: Life = item.life
        life.enter(STARTED if item.name == "on_start" else RECOVERED)
        try:
            result = actor.on_start(True) if item.name == "on_start" else actor.on_recovered()
        except Refusal as no:  # Nobody asked: an actor that refuses to start has failed to.
            raise StartFailed(life.cell.path, str(no)) from no
        if type(result) is Coroutine_:
            return item.finish(result)
        item.over()
        return None

    async def finish(self, hook: Any) -> None:
        try:
            await hook
        except Refusal as no:
            raise StartFailed(self.life.cell.path, str(no)) from no
        self.over()

    def is_start(self) -> bool:
        return True

    def ignored(self, cell: Cell, why: str) -> bool:
        """Called when the hook raised `Ignore`."""
        if self.name == "on_start":
            self.life.ignore(why)
        return self.name == "on_start"

    def over(self) -> None:
        """Leave the hook, which has returned."""
        self.life.leave()


class GoLive(Hook):
    """Everything that was handled before has been handled again."""

    __slots__ = ("go",)

    def __init__(self, life: Life, go: Go) -> None:
        super().__init__(life, "on_recovered")
        self.go = go

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        # Turns that failed are not replayed, but their numbers are used.
        item.life.turn = max(item.life.turn, item.go.turn)
        timers = item.life.timers
        for key in item.go.spent:
            timers.came(key)
        timers.running = dict(item.go.timers or timers.active)
        if item.go.recovered and type(actor).on_recovered is not Actor.on_recovered:
            item.life.hook_changes()
            return Hook.run(actor, item)
        item.over()
        return None

    def over(self) -> None:
        super().over()
        self.life.stage.begun = self.go.begun
        self.life.stage.judge(self.go)
        self.life.go_live(self.go.gone)


class WorkFailed(Piped):
    """A background task has raised: the life ends, and the next one does not begin that task again by a replay."""

    __slots__ = ("life",)

    def __init__(self, life: Life, error: BaseException | None) -> None:
        super().__init__(None, error)
        self.life = life

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        item.life.save_before_crash()
        return Piped.run(actor, item)


class TakeSnapshot(Item):
    """A command: save the state now, between two turns."""

    __slots__ = ("life",)
    comes_again = True

    def __init__(self, life: Life) -> None:
        self.life = life

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        item.life.take_snapshot()
        return None


class StopRecorded(lifecycle.Stop):
    """A command: end in good order, with a final snapshot."""

    __slots__ = ("life",)

    def __init__(self, life: Life, reason: ExitReason) -> None:
        super().__init__(reason)
        self.life = life

    @staticmethod
    def run(actor: Any, item: Any) -> object:
        life: Life = item.life
        life.take_snapshot(is_last=True)
        life.enter(STOP)
        if life.stage.is_cut_off or life.stage.is_adrift:
            lifecycle.finish(life.cell, item.reason, is_orderly=False)
        else:
            lifecycle.stop(life.cell, item.reason, item)
        return LEAVE
