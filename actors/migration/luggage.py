"""Packs and unpacks what an actor takes along when it moves between a task and an OS process.

Handles that only mean something at one place (timers, rights to reply, watches) may be in the state: they are
packed by what they stand for, and the actor finds handles of the same meaning in their place.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, cast

from ..control.live_state import live_state, put_state
from ..errors import BadMessage, HoldfastError, error_text, type_name
from ..exit_reasons import pack_exit, unpack_exit
from ..kernel import mailbox
from ..kernel.codec import Parcel
from ..kernel.envelope import Ask, AskHandle, Envelope, Item
from ..kernel.links import Down, Exit, LifeMonitor
from ..kernel.message import message_name
from ..kernel.timers import LoopTimer
from ..state_hooks import state_getter
from ..values import UnsavableValue, decode_value, encode_value

if TYPE_CHECKING:
    from ..kernel.actor import Actor
    from ..kernel.cell import Cell

Owe = Callable[[Ask], int]
"""A number under which the other side knows an ask that is to be answered."""
Owed = Callable[[int], Ask]
"""The ask that is known under a number."""


class Stays(HoldfastError, text="{why}"):
    """Why an actor cannot leave the place it lives in."""

    why: str


@dataclasses.dataclass(frozen=True, slots=True)
class PackedHandle:
    """Stands in a packed state for a handle: "timer", "reply" or "watch", and what it is known by."""

    kind: str
    key: Any


def lift(value: Any, found: Callable[[Any], Any]) -> Any:
    """A value with what `found` gives for what is no container in it; containers of builtin types are made anew."""
    kind = type(value)
    if kind is dict:
        return {lift(key, found): lift(inner, found) for key, inner in value.items()}
    if kind in (list, tuple, set, frozenset):
        return kind(lift(inner, found) for inner in value)
    if kind is deque:
        return deque((lift(inner, found) for inner in value), value.maxlen)
    return found(value)


def unanswerable(count: int) -> Stays:
    """So many promised replies could not be given any more."""
    return Stays(f"{count} asks wait for replies, and their reply handles are not in its state")


class StatePacker:
    """Packs the state of an actor, and knows which asks it can still answer from there."""

    def __init__(self, actor: Actor, owe: Owe) -> None:
        self._actor, self._owe = actor, owe
        self._timers = list(actor.ctx._cell.extra().belongings.timers)
        self._owed: set[int] = set()

    def pack(self) -> bytes:
        """The state.

        Raises:
            UnsavableValue: naming what cannot be packed. Stays: an ask could not be answered any more. Whatever
                `get_state` raises.
        """
        actor = self._actor
        state, where = live_state(actor), f"{actor.ctx.path}: {type_name(type(actor))}"
        try:
            packed = encode_value([False, state], where=where)
        except UnsavableValue:  # Once more, variable by variable, and with the handles in it by what they stand for.
            packed = encode_value([True, self._named(where, state)], where=where)
        lost = sum(not ask.is_done and id(ask) not in self._owed for ask in actor.ctx._promised())
        if lost:
            raise unanswerable(lost)
        return packed

    def _named(self, where: str, state: Any) -> Any:
        lifted = lift(state, self._stand_in)
        if state_getter(self._actor) is not None:
            encode_value(lifted, where=f"{where}.get_state()")
        else:
            for name, value in lifted.items():
                encode_value(value, where=f"{where}.{name}")
        return lifted

    def _stand_in(self, value: Any) -> Any:
        if isinstance(value, LoopTimer):
            return PackedHandle("timer", self._timers.index(value) if value in self._timers else -1)
        if type(value) is AskHandle:
            ask = value.ask
            if ask is None or ask.is_done:
                return PackedHandle("reply", -1)
            self._owed.add(id(ask))
            return PackedHandle("reply", self._owe(ask))
        if isinstance(value, LifeMonitor):
            return PackedHandle("watch", [value.name, value.for_good])
        return value


def pack_rest(actor: Actor) -> dict[str, Any]:
    """What else belongs to the life, as plain data: to be packed when nothing comes any more.

    Raises:
        BadMessage: the message of a timer cannot be coded.
    """
    cell = actor.ctx._cell
    more, codec = cell.extra(), cell.node.codec
    timers: list[Any] = []
    for timer in more.belongings.timers:
        message, left, interval, queued = timer.packed()
        timers.append([message_name(type(message)), codec.encode(message, cell.path), left, interval, queued])
    watches = [[watch.name, watch.for_good] for watch in more.ties.watching if watch.life == cell.life]
    downs = [item.watch for item in cell.queue or () if type(item) is Down and item.watch.active]
    watches += [[watch.name, watch.for_good] for watch in downs if watch not in more.ties.watching]
    return {
        "timers": timers,
        "trap_exits": more.trap_exits,
        "suspended": bool(more.suspended & mailbox.BY_USER),
        "links": list(more.ties.links.values()),
        "watches": watches,
    }


def unpack(
    actor: Actor, state: bytes, rest: dict[str, Any], owed: Owed, watched: Callable[[str, bool], LifeMonitor]
) -> None:
    """Give a new life what the old one has packed; `owed` and `watched` find what its handles stand for.

    Raises:
        HoldfastError, or whatever `set_state` raises: it does not fit.
    """
    cell = actor.ctx._cell
    codec = cell.node.codec
    cell.extra().trap_exits = rest["trap_exits"]
    actor.ctx._borrow_promises()
    timers: list[LoopTimer] = []
    for name, body, left, interval, queued in rest["timers"]:
        message = codec.decode(cell.table.kind_named(name), body)
        timers.append(LoopTimer.unpacked(cell, message, left, interval, queued))

    def found(value: Any) -> Any:
        if not isinstance(value, PackedHandle):
            return value
        match value.kind:
            case "timer":
                return timers[value.key] if value.key >= 0 else over(cell)
            case "reply":
                return AskHandle[Any](None) if value.key < 0 else actor.ctx._promise(owed(value.key))
            case _:
                return watched(*value.key)

    node = cell.node
    imports = node.ports.uplink is not None
    holds, values = cast("list[Any]", decode_value(state, imports=imports, refs=node.ref_at))
    put_state(actor, lift(values, found) if holds else values)


def over(cell: Cell) -> LoopTimer:
    """A timer whose message has come, or never will."""
    timer: LoopTimer = LoopTimer.__new__(LoopTimer)
    LoopTimer.ended(timer, cell)
    return timer


# -- what is queued in a process, for its home -----------------------------------------------------------------------


def pack_items(cell: Cell, items: Any, entry: Callable[[Item], list[Any] | None]) -> list[list[Any]]:
    """Queued or stashed items as plain data; `entry` has those that the home knows by a number.

    Raises:
        Stays: one cannot be packed.
    """
    packed: list[list[Any]] = []
    for item in items:
        known = entry(item) if isinstance(item, Item) else None
        if known is not None:
            packed.append(known)
        elif isinstance(item, Exit):
            if item.active:
                packed.append(["exit", item.source.path, pack_exit(item.reason)])
        elif isinstance(item, Down):
            if item.watch.active:
                watch = item.watch
                packed.append(["down", watch.target.path, pack_exit(item.reason), item.recovering, watch.for_good])
        elif isinstance(item, Envelope) or not isinstance(item, Item):
            message, sender = (item.message, item.sender) if isinstance(item, Envelope) else (item, None)
            if isinstance(message, Parcel):
                name, body = message.name, message.body
            else:
                name, body = message_name(type(message)), cell.node.codec.encode(message, cell.path)
            packed.append(["message", name, body, None if sender is None else sender.path])
    return packed


def unpack_items(cell: Cell, packed: list[list[Any]], known: Callable[[list[Any]], Any]) -> list[Any]:
    """The items again, at their home; `known` has those that it knows by a number."""
    node, items = cell.node, list[Any]()
    for entry in packed:
        match entry:
            case ["exit", str(source), reason]:
                items.append(Exit(node.cell_at(source), unpack_exit(reason)))
            case ["down", str(source), reason, bool(recovering), bool(for_good)]:
                watch = LifeMonitor(cell, node.cell_at(source), for_good)
                items.append(Down(watch, unpack_exit(reason), recovering))
            case ["message", str(name), bytes(body), sender]:
                message = node.codec.decode(cell.table.kind_named(name), body)
                items.append(message if sender is None else Envelope(message, node.cell_at(sender)))
            case _:
                item = known(entry)
                if item is not None:
                    items.append(item)
    return items


def check_sendable(cell: Cell) -> None:
    """Whether all that is queued or stashed can be sent to another process.

    Raises:
        Stays: naming the first message that cannot.
    """
    stash = cell.more.stash if cell.more is not None else None
    for item in (*(stash or ()), *(cell.queue or ())):
        message = item.message if isinstance(item, (Ask, Envelope)) else item
        if isinstance(message, Item):
            continue
        try:
            cell.node.codec.encode(message, cell.path)
        except BadMessage as error:
            raise Stays(f"a queued message cannot be sent to another process ({error_text(error)})") from error


def refuse(cell: Cell, item: Any, error: HoldfastError) -> None:
    """An item cannot be brought to its actor."""
    if isinstance(item, Ask):
        item.fail(error)
    else:
        cell.node.dead_letter(cell, item.message if isinstance(item, Envelope) else item, str(error))


def let_come(cell: Cell, items: Iterable[Any]) -> None:
    """Have what has waited on the way come to its actor where it lives now; whoever finds no room there is told so."""
    for item in items:
        try:
            cell.admit(cell, item)
        except HoldfastError as error:
            refuse(cell, item, error)
