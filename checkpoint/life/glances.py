"""Asks that change nothing, answered beside a turn that rests, or has an effect out: nothing else is handled then."""

from __future__ import annotations

import types
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

from ...actors.kernel.envelope import ReplyHandle
from ...actors.kernel.message import Message, Refusal
from ...actors.kernel.ref import current
from ..protocol import Answer, Feed, Glanced
from .recorded_inbox import Fed

if TYPE_CHECKING:
    from ...actors.kernel.cell import Cell
    from ...actors.kernel.ref import ActorRef
    from .recorded_life import Life


T = TypeVar("T")


class NeedsTurn(BaseException):
    """A handler wants more than to look at the state: its message waits for a turn. No user code is to catch this."""


class GlanceContext:
    """Stands for the actor's `ctx` while it is looked at: the turn that rests must not be touched."""

    def __init__(self, cell: Cell, life: Life, feed: Feed) -> None:
        self._cell, self._life, self._feed = cell, life, feed

    @property
    def ref(self) -> ActorRef[Any]:
        """A ref to this actor."""
        return self._cell.ref

    @property
    def path(self) -> str:
        """The address of this actor."""
        return self._cell.path

    @property
    def life(self) -> int:
        """The number of this life at the address, from 1."""
        return self._cell.life

    @property
    def sender(self) -> ActorRef[Any] | None:
        """A ref to the actor that has asked; None if no actor did."""
        sender = self._feed.sender
        return None if sender is None else self._cell.node.cell_at(sender).ref

    def now(self) -> float:
        """Unix time in seconds, of the message in hand."""
        return self._feed.time

    def __getattr__(self, name: str) -> Any:
        raise NeedsTurn

    def __setattr__(self, name: str, value: Any) -> None:
        if not name.startswith("_"):
            raise NeedsTurn
        object.__setattr__(self, name, value)


def answer_beside(life: Life, feed: Feed) -> None:
    """Answer an ask beside the turn in hand, if that still waits, and if the handler does no more than look.

    Else nothing has happened, and it waits for its turn as everything else; so does what raises.
    """
    if life.cell.more is not None and life.cell.more.suspended:
        return
    seen = seen_beside(life, feed, lambda: _answered(life, feed))
    if seen is not None:
        life.drop_queued(feed.id)
        life.port.to_home(Glanced(feed.id, seen[0]))


def seen_beside(life: Life, feed: Feed | None, look: Callable[[], T]) -> tuple[T] | None:
    """What is seen beside the turn in hand, if that waits, for whoever asks by `feed`; None: nothing has happened."""
    cell, context = life.cell, life.cell.context
    more, actor = cell.more, cell.actor
    turn = None if more is None else more.turn
    if life.stage.is_over or not life.is_live or not life.waits.is_open or context is None or actor is None:
        return None
    if feed is None or turn is None or turn.killed or turn.then is not None:
        return None
    standing: Any = GlanceContext(cell, life, feed)
    context, ctx = context.copy(), actor.ctx
    context.run(current.set, standing)
    actor.ctx = standing
    how = 0 if life.word is None else life.word.how
    if life.word is not None:
        life.word.look(feed.id)  # If the process dies of it.
    try:
        return (cell.node.step_beside(context, look),)
    except BaseException:  # Whatever user code raises: it does so again in its turn, which is judged as any other.
        return None
    finally:
        actor.ctx = ctx
        if life.word is not None:
            life.word.mark(how)


def _answered(life: Life, feed: Feed) -> Answer:
    message: Message[Any] = life.cell.node.codec.message_in(life.cell, feed.name, feed.body)
    fed = Fed(life, feed, message, None, feed.chain)
    try:
        result = fed.call(life.cell.actor)
        if isinstance(result, types.CoroutineType):
            result = _returned(result)
    except Refusal as no:
        return life.answer_error(no)
    if isinstance(result, ReplyHandle):
        raise NeedsTurn
    return life.answer_reply(result, type(message))


def _returned(running: types.CoroutineType[Any, Any, Any]) -> Any:
    """What an async handler returns without waiting for anything."""
    try:
        running.send(None)
    except StopIteration as done:
        return done.value
    finally:
        running.close()
    raise NeedsTurn
