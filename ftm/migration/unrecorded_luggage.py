"""What goes along when a life that is not recorded is handed over between a subtree's process and the root.

Whoever waits for a reply is answered over the connection, wherever the asked actor lives then.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from ...actors.errors import HoldfastError
from ...actors.kernel.codec import Parcel
from ...actors.kernel.envelope import Ask, Envelope, Item
from ...actors.kernel.message import message_name
from ...actors.migration.luggage import pack_items, unpack_items
from ...actors.process.wire.peer import Peer, RelayedAsk

if TYPE_CHECKING:
    from ...actors.kernel.cell import Cell


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


def refuse(cell: Cell, item: Any, error: HoldfastError) -> None:
    """An item cannot be brought to its actor."""
    if isinstance(item, Ask):
        item.fail(error)
    else:
        cell.node.dead_letter(cell, item.message if isinstance(item, Envelope) else item, str(error))
