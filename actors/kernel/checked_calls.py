"""Checks what users send to the runtime's own actors: a wrong value in a field is an answer, and ends nobody."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import msgspec

from ..errors import BadMessage, HoldfastError, SpecError, shown, type_name
from .codec import decode_error, misfit
from .envelope import AskHandle
from .message import Refusal

if TYPE_CHECKING:
    from collections.abc import Callable

    from .actor import Actor
    from .context import ActorContext
    from .envelope import ReplyHandle
    from .message import RuntimeCall


def checking(handler: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """The handler of a call, which refuses one whose fields are not what its class declares."""

    @functools.wraps(handler)
    def turn(actor: Actor, message: RuntimeCall[Any]) -> Any:
        if problem := misfit_of(message):
            return refuse(actor.ctx, BadMessage(actor.ctx.path, type_name(type(message)), problem))
        return handler(actor, message)

    return turn


def misfit_of(message: RuntimeCall[Any]) -> str:
    """Why a message could not come from another process as it is; "" if it could, or holds what is never sent there.

    >>> class Pick(RuntimeCall[None]):
    ...     id: str
    >>> misfit_of(Pick("a")), misfit_of(Pick(["a"])), misfit_of(Pick("half a pair: \\ud800"))
    ('', 'Expected `str`, got `array` - at `id`', "Expected text that can be written, got 'half a pair: ?' - at `id`")
    """
    kind = type(message)
    values = msgspec.structs.astuple(message)
    for name, value in zip(kind.__struct_fields__, values, strict=True):
        if isinstance(value, str) and not value.isascii():
            try:
                value.encode()
            except UnicodeEncodeError:
                return f"Expected text that can be written, got {shown(value)} - at `{name}`"
    try:
        msgspec.convert(values, kind, builtin_types=(bytes,))
    except Exception as error:  # What a field holds may raise what it likes while it is looked at.
        return misfit(kind, decode_error(error))
    return ""


def refuse(ctx: ActorContext, error: HoldfastError) -> ReplyHandle[Any]:
    """Answer the call in hand with an error; if nobody has asked, that is logged. The actor goes on."""
    handle: ReplyHandle[Any] = ctx.reply_handle()
    fail(ctx, handle, ctx._item, error)
    return handle


def fail(ctx: ActorContext, handle: ReplyHandle[Any], item: object, error: HoldfastError) -> None:
    """Answer by an error through a handle for `item`; if nobody has asked, and it is the call that is wrong, log it."""
    handle.fail(error)
    if isinstance(handle, AskHandle) and handle.ask is None and isinstance(error, (Refusal, BadMessage, SpecError)):
        ctx._cell.node.refused(ctx._cell, item, error)
