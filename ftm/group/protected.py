"""The protection status of an actor: its mechanisms, who leads, and whether a replica may die."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ...actors.kernel.cell import Cell


@dataclasses.dataclass(frozen=True, slots=True)
class ProtectionStatus:
    """The mechanisms and replicas that protect an actor, as `system.protection` tells of them."""

    address: str
    stack: tuple[str, ...]
    """The names of its mechanisms, outermost first; none if it is not protected."""
    replicas: dict[str, str]
    """By name: "leads", "follows" (it could lead), "joining", "silent" (it is suspected), or "down"."""
    leader: str | None
    """The one that leads; None while there is none."""
    epoch: int
    """It rises with each failover and each new life."""
    config: int
    """It rises with each change of the stack."""
    is_whole: bool
    """Whether one replica leads, and all others could."""
    since: float
    """Since when it is whole, or is not: seconds since the epoch of the clock; 0.0 if it is not protected."""
    is_changing: bool
    """Whether another stack is on its way."""
    is_on_probation: bool
    """Whether the stack is new, and the one before may yet come back."""

    @property
    def is_protected(self) -> bool:
        """Say whether the actor has any mechanism."""
        return bool(self.stack)


def protection_of(cell: Cell) -> ProtectionStatus:
    """What the root knows of the protection of an address."""
    from .group_place import GroupPlace  # Whoever only reads an answer, in another process, needs none of it.

    place = cell.host.place
    if not isinstance(place, GroupPlace):
        return ProtectionStatus(cell.path, (), {}, None, 0, 0, False, 0.0, False, False)
    stack, group, probation = tuple(layer.name for layer in place.layers), place.group, place.probation
    is_new = probation is not None and not probation.is_over
    if group is None or group.membership.is_over:  # It is being recovered.
        return ProtectionStatus(
            cell.path, stack, {}, None, place.epoch, place.config, False, place.ended_at, False, is_new
        )
    known, adaptation = group.membership, group.adaptation
    replicas = place.replica_states()
    is_whole, since = group.replicas.whole_since()
    is_changing = adaptation.change is not None
    return ProtectionStatus(
        cell.path, stack, replicas, known.primary, known.epoch, adaptation.config, is_whole, since, is_changing, is_new
    )
