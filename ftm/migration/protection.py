"""Chooses the sides of a migration into a group of replicas, or out of one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ...actors.errors import CannotMove
from ...actors.kernel.lifecycle import LOCAL
from ...actors.migration.move import Move, Pause
from ...actors.process.wire.peer import OutsideHost
from ...checkpoint.home.journal_home import JournalHome
from ...checkpoint.places.far_parent import FarParent, SlotPlace
from ...checkpoint.places.recorded_moves import ToRecordedWorker, leaving
from ...supervision.respec import recipe_spec
from ..group.group_place import GroupPlace, protected_host
from ..group.transient_homes import UNKEPT, TransientHome
from .group_moves import AtRest, FromGroup, FromRecordedGroup, ToGroup
from .subtree_moves import (
    FromRecordedSubtree,
    FromSubtree,
    ToRecordedSubtree,
    ToSubtree,
    group_for,
    parent_of,
    spec_of,
    to_process_below,
)

if TYPE_CHECKING:
    from ...actors.kernel.cell import Cell
    from ...actors.migration.move import Entering
    from ...checkpoint.home.homes import Homes
    from ..bricks.sealed_frames import MovedCertificates

PART = ("ftm",)
"""What a group's parts are children of: no children of the actor's own."""


def into_group(cell: Cell, homes: Homes, mechanism: Any, timeout: float) -> Move:
    """The move of an actor into a group.

    Raises:
        CannotMove: it lives somewhere else.
    """
    old, home, parent = cell.host, cell.host.home, cell.host.parent
    if old is LOCAL:
        return Move(cell, leaving(cell, PART), ToGroup(protected_host(homes, None, mechanism), None), timeout)
    if isinstance(home, JournalHome) and isinstance(parent, FarParent):
        spec = spec_of(cell)
        below = group_for(parent, spec, home.method, mechanism)
        is_there = isinstance(cell.host.place, SlotPlace)  # Else it has a process of its own.
        leaves = FromRecordedSubtree(cell, parent, spec, below) if is_there else leaving(cell, PART)
        return Move(cell, leaves, ToGroup(below, home.switch), timeout)
    if isinstance(home, JournalHome):
        group = protected_host(homes, home.method, mechanism)
        return Move(cell, leaving(cell, PART), ToGroup(group, home.switch), timeout)
    if isinstance(old, OutsideHost):
        spec, parent = spec_of(cell), parent_of(cell, old)
        below = group_for(parent, spec, UNKEPT, mechanism)
        return Move(cell, FromSubtree(cell, parent, spec, below), ToGroup(below, None), timeout)
    raise CannotMove(cell.path, "only an actor that lives as a task can be given a mechanism")


def out_of_group(cell: Cell, entering: Entering, timeout: float) -> Move:
    """The move of a group's life to where its supervisor is; if that is the root, it enters there.

    Raises:
        CannotMove: it is being recovered.
    """
    parent = cell.host.parent
    from_group, to_subtree = (FromGroup, ToSubtree) if is_plain(cell) else (FromRecordedGroup, ToRecordedSubtree)
    if isinstance(parent, FarParent):
        spec, home = recipe_spec(cell), cell.host.home
        if isinstance(home, JournalHome) and not is_plain(cell) and spec is not None and spec.isolation == "process":
            into = ToRecordedWorker(to_process_below(parent, spec, home.method), spec.limits)
            return Move(cell, from_group(cell, is_below=True), into, timeout)
        return Move(cell, from_group(cell, is_below=True), to_subtree(cell, parent), timeout)
    return Move(cell, from_group(cell, is_below=False), entering, timeout)


def rest_of_group(cell: Cell, timeout: float) -> Move:
    """The move in which a group only comes to rest, and goes on where it is.

    Raises:
        CannotMove: it is being recovered.
    """
    return Pause(cell, AtRest(cell), timeout)


def moved_certificates(cell: Cell, now: str) -> MovedCertificates | None:
    """What has to be certified before a protected actor goes to the address `now`; None: its links are not secured."""
    place = cell.host.place
    link = place.link if isinstance(place, GroupPlace) else None
    return None if link is None else link.moved_certificates(now)


def is_plain(cell: Cell) -> bool:
    """Whether the actor has no recovery, and a home only as long as a group lives it."""
    return isinstance(cell.host.home, TransientHome)
