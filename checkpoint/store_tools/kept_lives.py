"""What a store has kept of one address: from each kept snapshot on, the turns that follow it."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import msgspec

from ...actors.kernel.actor import Actor
from ...actors.kernel.node import Node, Ports
from ...actors.state_hooks import migrated, renames_in
from ...actors.values import decode_value, state_digest
from ..home.homes import Homes
from ..inputs import spread
from ..journal import Saved
from ..protocol import START
from ..schema import other_class
from ..snapshot.key_variables import save_state
from ..snapshot.shared_blocks import by_segment
from ..snapshot.snapshot_record import Meta, decode_meta, encode_meta
from ..snapshot.state_image import read_saved

if TYPE_CHECKING:
    from ...actors.kernel.cell import Cell
    from ..journal import StoreEngine


class KeptLife(NamedTuple):
    """A snapshot and all that follows it; `meta` is None if there is none."""

    saved: Saved
    meta: Meta | None

    @property
    def turn(self) -> int:
        """The last turn that its state contains; -1 if it begins at the very start."""
        return -1 if self.meta is None else self.meta.turn

    @property
    def kind(self) -> str:
        """The name of the class that has lived it; "" if nothing says so."""
        if self.meta is not None and self.meta.made.kind:
            return self.meta.made.kind
        entries = (one for _, entry in self.saved.entries for one in spread(entry))
        return next((cast("bytes", one[4]).decode() for one in entries if one[0] == "in" and one[2] == START), "")


def lives_of(lives: list[KeptLife], kind: type[Actor]) -> tuple[list[KeptLife], str]:
    """Those that a class goes on with, and what is to be said of earlier ones, which another class has lived.

    A program begins with the latest life, and that one is always among them, so that what starts it judges whether the
    class fits it.
    """
    first = len(lives) - 1
    while first and not other_class(lives[first - 1].kind, kind):
        first -= 1
    if not first:
        return lives, ""
    was = lives[first - 1].kind
    return lives[first:], f"turns up to {lives[first].turn} were handled by {was}, which was replaced behind them"


def lives_to(lives: list[KeptLife], until: int | None) -> list[KeptLife]:
    """Those from which turns up to `until` (None: all of them) lead to the state that was there then.

    Turns before a state or a class was put in place from outside do not lead to what follows.
    """
    some = [one for one in lives if until is None or one.turn < until] or lives[:1]
    replaced = [number for number, one in enumerate(some) if one.meta is not None and one.meta.is_replaced]
    return some[max(replaced, default=0) :]


def kept_lives(homes: Homes, path: str) -> list[KeptLife]:
    """What is kept of an address, from each snapshot on, the oldest first.

    Raises:
        DamagedStore: none can be trusted. HoldfastError: it is of a format that this holdfast does not know.
    """
    kept: list[Saved] = []
    while not kept or kept[-1].snapshot is not None:
        saved = homes.journal.load(path, older=len(kept))
        if kept and saved.snapshot == kept[-1].snapshot:
            break  # There is no older one.
        kept.append(saved)
    return [_whole(homes, path, saved) for saved in reversed(kept)]


def _whole(homes: Homes, path: str, saved: Saved) -> KeptLife:
    """The same with the state in one piece."""
    if saved.snapshot is None:
        return KeptLife(saved, None)
    meta = decode_meta(saved.snapshot)
    if not meta.blocks:
        return KeptLife(saved, meta)
    segments = {number: homes.journal.read_blocks(path, number, at) for number, at in by_segment(meta.blocks).items()}
    try:
        state = b"".join(segments[number].block(offset, length) for number, offset, length in meta.blocks)
    finally:
        for segment in segments.values():
            segment.close()
    meta = msgspec.structs.replace(meta, state=state, blocks=[])
    return KeptLife(saved._replace(snapshot=encode_meta(meta, compress=False)), meta)


def apart(node: Node, engine: StoreEngine) -> Homes:
    """The homes of a store by themselves: at all addresses there are stand-ins, one for each."""
    homes = Homes(node, engine)
    cells: dict[str, Cell] = {}

    def stand_in(path: str) -> Cell:
        cell = cells.get(path)
        if cell is None:
            cell = cells[path] = node.nowhere(homes.addresses.now(path))
        return cell

    node.connect(Ports(outside=stand_in, keeper=homes))
    return homes


def state_differences(actor: Actor, saved: bytes) -> list[str]:
    """In which variables an actor's state is not the saved one, in words; what only its class now has does not count.

    Raises:
        DamagedValue, StateMismatch, UnsavableValue: the two cannot be compared.
    """
    was, now = _read(actor, saved), _read(actor, save_state(actor))
    if not isinstance(was, dict) or not isinstance(now, dict):
        was, now = {"the state": was}, {"the state": now}
    found: list[str] = []
    for name, value in was.items():
        if name not in now:
            found.append(f"{name} was {cut(repr(value))}, and is not there now")
        elif state_digest(value) != state_digest(now[name]):
            found.append(f"{name} was {cut(repr(value))}, now it is {cut(repr(now[name]))}")
    return found


def _read(actor: Actor, data: bytes) -> Any:
    """A saved state as the actor's class now wants it."""
    saved: Any = read_saved(data, partial(decode_value, refs=actor.ctx._cell.node.ref_at))
    version, form, state = saved
    kind = type(actor)
    if form == "keys" and isinstance(state, dict):
        names = renames_in(actor, state)
        state = {names.get(name, name): value for name, value in state.items()}
    return state if version == kind.schema_version else migrated(kind, state, version, actor.ctx.path)


def cut(text: str, most: int = 120) -> str:
    """A text, not too long.

    >>> cut("0123456789", 4)
    '0123... (10 characters)'
    """
    return text if len(text) <= most else f"{text[:most]}... ({len(text)} characters)"
