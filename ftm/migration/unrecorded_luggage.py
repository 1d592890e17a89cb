"""The luggage of a life without recovery, between a subtree's process and the root.

Whoever waits for a reply is answered over the connection, wherever the asked actor lives then.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

from ...actors.errors import HoldfastError
from ...actors.kernel.codec import Parcel
from ...actors.kernel.envelope import Ask, AskHandle, Item
from ...actors.kernel.message import message_name
from ...actors.migration.luggage import lift, pack_items, refuse, unanswerable, unpack_items
from ...actors.process.wire.peer import Peer, RelayedAsk
from ...actors.values import UnsavableValue
from ...checkpoint.life.recorded_context import RecordedReplyHandle
from ...checkpoint.snapshot.key_variables import restore_state, save_state

if TYPE_CHECKING:
    from ...actors.kernel.actor import Actor
    from ...actors.kernel.cell import Cell

FIRST_OWED = -2
"""The number of the first reply that was promised before there was a home, which counts its inputs from 1 up."""


def save_owing(actor: Actor) -> tuple[bytes, dict[int, Ask]]:
    """The state of an actor without a home, as one that has a home saves it, and the asks it has promised to answer.

    Raises:
        UnsavableValue, StateMismatch: as `save_state`. Stays: the handle of a promised reply is not in the state.
    """
    owed: dict[int, Ask] = {}

    def told(value: Any) -> Any:
        if type(value) is not AskHandle:
            return value
        ask = value.ask
        if ask is None or ask.is_done:
            return RecordedReplyHandle[Any](-1)
        number = next((number for number, one in owed.items() if one is ask), FIRST_OWED - len(owed))
        owed[number] = ask
        return RecordedReplyHandle[Any](number, message_name(type(ask.message)))

    try:
        data = save_state(actor)
    except UnsavableValue:
        data = save_state(actor, lambda state: lift(state, told))
    if lost := sum(not ask.is_done and ask not in owed.values() for ask in actor.ctx._promised()):
        raise unanswerable(lost)
    return data, owed


def restore_owing(actor: Actor, data: bytes, owed: Mapping[int, Ask]) -> None:
    """Give a life without a home the state that one with a home has saved, and the asks that it is to answer.

    Raises:
        DamagedValue, StateMismatch: as `restore_state`. Stays: the handle of a promised reply is not in the state.
    """
    found: set[int] = set()

    def meant(value: Any) -> Any:
        if type(value) is not RecordedReplyHandle:
            return value
        ask = owed.get(value.id)
        if ask is None:
            return AskHandle[Any](None)
        found.add(value.id)
        return actor.ctx._promise(ask)

    actor.ctx._borrow_promises()
    restore_state(actor, data, meant=lambda saved: lift(saved, meant))
    if lost := sum(not ask.is_done for number, ask in owed.items() if number not in found):
        raise unanswerable(lost)


class EarlyAsk(RelayedAsk, eq=False):
    """An ask of the other side that this one may have to answer. What is said before that is known waits."""

    said: Any = None

    @classmethod
    def early(cls, peer: Peer) -> EarlyAsk:
        """An ask whose number is not known yet."""
        return cls(None, None, (), 0.0, 0.0, None, None, True, peer)

    def is_ours(self, number: int) -> None:
        """It is to be answered from here, by this number."""
        self.id, said, self.said = number, self.said, None
        if said is not None:
            self.is_over = False
            said()

    def answer(self, reply: object) -> None:
        if self.id:
            super().answer(reply)
        else:
            self._keep(functools.partial(RelayedAsk.answer, self, reply))

    def fail_raw(self, kind: str, name: str, body: bytes) -> None:
        if self.id:
            super().fail_raw(kind, name, body)
        else:
            self._keep(functools.partial(RelayedAsk.fail_raw, self, kind, name, body))

    def _keep(self, said: Callable[[], None]) -> None:
        if not self.is_over:
            self.is_over, self.said = True, said


def pack_owed(peer: Peer, owed: Mapping[int, Ask]) -> list[list[Any]]:
    """The asks that the other side shall answer from now on: number in the state, number of the ask, seconds left."""
    now = peer.node.loop.time()
    return [[number, peer.expect(ask), ask.deadline - now] for number, ask in owed.items() if not ask.is_done]


def unpack_owed(peer: Peer, cell: Cell, packed: Iterable[list[Any]]) -> dict[int, Ask]:
    """The same, where they are to be answered."""
    now = peer.node.loop.time()
    return {
        number: RelayedAsk(None, None, (), left, now + left, None, cell, True, peer, key)
        for number, key, left in packed
    }


def pack_ask(peer: Peer, ask: Ask, name: str, body: bytes) -> list[Any]:
    """An ask that the other side shall answer."""
    sender = None if ask.sender is None else ask.sender.path
    left = ask.deadline - peer.node.loop.time()
    ask.started = True  # From here on we cannot know.
    return ["ask", peer.expect(ask), name, body, sender, ask.chain, left]


def pack(peer: Peer, cell: Cell, items: Iterable[Any]) -> list[list[Any]]:
    """What waits at an actor, in order; what cannot be sent is refused."""

    def entry(item: Item) -> list[Any] | None:
        if not isinstance(item, Ask):
            return None
        message = item.message
        if isinstance(message, Parcel):
            return pack_ask(peer, item, message.name, message.body)
        return pack_ask(peer, item, message_name(type(message)), cell.node.codec.encode(message, cell.path))

    packed: list[list[Any]] = []
    for item in items:
        if isinstance(item, Ask) and item.is_done:
            continue
        try:
            packed += pack_items(cell, (item,), entry)
        except HoldfastError as error:
            refuse(cell, item, error)
    return packed


def unpack(peer: Peer, cell: Cell, packed: Iterable[list[Any]]) -> list[Any]:
    """The same again, where the actor lives now."""
    node, items = cell.node, list[Any]()

    def asked(entry: list[Any]) -> RelayedAsk:
        _, key, name, body, sender, chain, left = entry
        source = None if sender is None else node.cell_at(sender)
        chain, deadline = tuple(map(tuple, chain)), node.loop.time() + left
        ask = RelayedAsk(None, source, chain, left, deadline, None, cell, False, peer, key)
        try:
            ask.message = node.codec.decode(cell.table.kind_named(name), body)
        except Exception as error:  # msgspec's own, or what a hook raised: all say that it does not fit.
            ask.fail(error)
        return ask

    for entry in packed:
        try:
            items += unpack_items(cell, [entry], asked)
        except Exception as error:  # The same for a message that nobody waits for.
            node.dead_letter(cell, Parcel(str(entry[1]), bytes(entry[2])), str(error))
    return [item for item in items if not (isinstance(item, Ask) and item.is_done)]
