"""A check, for tests, that handlers declared readonly change nothing. It is slow."""

from __future__ import annotations

import types
from typing import TYPE_CHECKING, Any

from ...actors.errors import HoldfastError
from ...actors.kernel.actor import Actor
from ...actors.kernel.envelope import Table
from ...actors.kernel.message import message_name
from ...actors.values import decode_value, state_digest
from ..snapshot.key_variables import save_state

if TYPE_CHECKING:
    from .recorded_life import Life


class NotReadonly(
    HoldfastError, text="{actor}: the handler of {message} is declared readonly and has changed {changed}"
):
    """A handler that is declared readonly has changed something: take `readonly=True` away, or the change."""

    actor: str
    message: str
    changed: str


def check_readonly(actor: Actor, life: Life) -> None:
    """Have this very actor's readonly handlers looked at in each turn; nobody else's take longer for it."""
    kind: Any = type(actor)
    table = Table()
    for message, declared in kind._declared.items():
        handler = kind._table[message]
        table[message] = _looked_at(handler, life, message_name(message)) if declared.readonly else handler
    instance: Any = actor
    instance._table = table


def _looked_at(handler: Any, life: Life, message: str) -> Any:
    def call(actor: Actor, given: Any) -> Any:
        before = _seen(actor, life)
        result = handler(actor, given)
        if isinstance(result, types.CoroutineType):
            return finish(actor, result, before)
        compare(actor, before)
        return result

    async def finish(actor: Actor, running: Any, before: dict[str, Any]) -> Any:
        result = await running
        compare(actor, before)
        return result

    def compare(actor: Actor, before: dict[str, Any]) -> None:
        after = _seen(actor, life)
        changed = [name for name in {**before, **after} if before.get(name) != after.get(name)]
        if changed:
            raise NotReadonly(life.cell.path, message, ", ".join(changed))

    return call


def _seen(actor: Actor, life: Life) -> dict[str, Any]:
    """What a snapshot would hold, variable by variable."""
    saved: Any = decode_value(save_state(actor), refs=life.cell.node.ref_at)
    state = saved[2]
    parts: dict[str, Any] = state if isinstance(state, dict) and saved[1] == "keys" else {"its state": state}
    seen: dict[str, Any] = {name: state_digest(value) for name, value in parts.items()}
    seen["what it has stashed"] = [fed.feed.id for fed in life.stash]
    seen["what goes on in the background"] = life.pipes
    return seen
