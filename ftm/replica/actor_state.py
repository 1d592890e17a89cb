"""Converts the state of the protected actor to bytes and back, between two turns only."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from ...actors.state_hooks import state_getter
from ...actors.values import decode_value, state_digest
from ...checkpoint.life.recorded_inbox import Fed
from ...checkpoint.protocol import Feed, Snapshot, pieces
from ...checkpoint.snapshot.key_variables import key_names, put_back, save_state, state_of, variables
from ..bricks.brick_messages import ServerState

if TYPE_CHECKING:
    from ..bricks.state_images import Image
    from .replica_life import ServerLife
    from .rewind_points import RewindPoints


def point_of(life: ServerLife, data: Image, deltas: list[bytes]) -> ServerState:
    """Put a state together with what else belongs to the life."""
    stash = [fed.feed for fed in life.stash]
    ids = () if life.is_live else sorted(life.restored.stash_ids)
    return ServerState(
        life.turn, data, deltas, stash, [fed.feed for fed in life.returned.values()], life.is_live,
        [key for key in ids if all(feed.id != key for feed in stash)], life.cell.extra().trap_exits,
        timers=life.timers.active,
    )  # fmt: skip


def names_of_state(actor: Any) -> set[str] | None:
    """Find the variables of an actor whose state consists of all of them; None if it says itself what its state is."""
    if state_getter(actor) is None and key_names(actor) is None:
        return set(variables(actor))
    return None


def take_up(life: ServerLife, point: ServerState, *, has_deltas: bool) -> None:
    """Bring a life that has begun with the whole state of a point to that point."""
    actor: Any = life.cell.actor
    life.cell.extra().trap_exits = point.traps
    for name in life.begun_names.intersection(point.absent):  # `__init__` has made it, a turn has deleted it.
        delattr(actor._state_root(), name)
    _apply_deltas(actor, point.deltas, has_deltas=has_deltas)
    life.timers.take(point.timers)
    life.stash += _fed(life, point.stash)
    life.returned |= _returned(life, point)


def rewind_to(life: ServerLife, point: ServerState, names: set[str] | None, *, has_deltas: bool) -> None:
    """Put the state of a point back, in place: the actor's object goes on.

    What is no state (attributes with a leading underscore) stays as it is.

    Args:
        life: of the actor.
        point: where it was before.
        names: the variables that the actor has had since, if its state consists of them.
        has_deltas: the actor says itself what has changed.
    """
    actor: Any = life.cell.actor
    saved = point.data.value(life.cell.node.ref_at)
    put_back(actor, saved)
    _apply_deltas(actor, point.deltas, has_deltas=has_deltas)
    if names is not None:
        for name in set(variables(actor)) - set(saved[2]):
            delattr(actor._state_root(), name)
    life.cell.extra().trap_exits, life.timers.active = point.traps, point.timers
    life.rewind(point.turn, _fed(life, point.stash), _returned(life, point))


def _apply_deltas(actor: Any, deltas: list[bytes], *, has_deltas: bool) -> None:
    for delta in deltas:
        actor.apply_delta(decode_value(delta, refs=actor.ctx._cell.node.ref_at))
    if has_deltas:
        actor.get_delta()  # What has changed up to here is known.


def _fed(life: ServerLife, feeds: Iterable[Feed]) -> list[Fed]:
    node = life.cell.node
    return [
        Fed(life, feed, None, None if feed.sender is None else node.cell_at(feed.sender), feed.chain) for feed in feeds
    ]


def _returned(life: ServerLife, point: ServerState) -> dict[int, Fed]:
    return {fed.feed.id: fed for fed in _fed(life, point.returned)}


def digest_of_life(life: ServerLife) -> bytes:
    """Take a digest of the state after the last turn, the same on each replica."""
    assert life.feed is None
    assert life.cell.actor is not None
    state = state_of(life.cell.actor)
    value: Any = state.value
    if type(value) is dict and all(type(name) is str for name in value):
        value = sorted(value.items())
    aside = [fed.feed.id for fed in life.stash], list(life.returned)
    return state_digest([life.turn, aside, [state.version, state.form, value]])


def snapshot_of(life: ServerLife, points: RewindPoints) -> list[Snapshot]:
    """Make the records of a snapshot for home.

    Raises:
        UnsavableValue, StateMismatch, what `get_state` raises: it cannot be saved.
    """
    begin, point = time.perf_counter(), points.point
    assert life.cell.actor is not None
    stands = point is not None and point.turn == life.turn and not point.deltas and not points.tail
    is_known = stands and not life.is_touched  # Else hooks may have changed it since.
    data = point.data.whole() if point is not None and is_known else save_state(life.cell.actor)
    stash = [fed.feed.id for fed in life.stash]
    parts, pause = pieces(data), time.perf_counter() - begin
    kind, names = life.made_by()
    return [
        Snapshot(life.turn, one, index == len(parts), stash, pause, traps=life.traps, kind=kind, variables=names)
        for index, one in enumerate(parts, 1)
    ]
