"""Protected children of a supervisor in another process: their groups are here, at the root.

The supervisor in the process wants a life; it is lived by replicas, which are processes of the root as always, and the
death of one of them does not concern that supervisor. It hears of the end of the life, and decides what follows. When
its process dies, the group ends with it; the home keeps what it holds until the subtree has been started again.
"""

from __future__ import annotations

import dataclasses
import sys
from typing import TYPE_CHECKING

import msgspec

from ...actors.errors import StartFailed
from ...actors.kernel.bindings import settle_claims
from ...actors.process.wire.start_codec import pack_recipe
from ...supervision.respec import recipe_spec
from ..group.group_place import GroupPlace, protected_host
from ..model.composition import check_stack, describe
from ..model.mechanism import COMMON, Code, Description, Mechanism, MechanismRefused, revive

if TYPE_CHECKING:
    from ...actors.kernel.address_host import AddressHost
    from ...actors.kernel.cell import Cell
    from ...checkpoint.places.far_parent import FarParent
    from ...checkpoint.protocol import Wanted


def group_below(parent: FarParent, cell: Cell, wanted: Wanted, before: AddressHost | None) -> AddressHost:
    """The host of the life that is wanted: that of the last one, if nothing has changed.

    Raises:
        HoldfastError: it cannot be protected so.
    """
    made = wanted.protected
    assert made is not None
    layers = tuple(map(known, msgspec.convert(made.layers, list[Description])))
    check_stack(layers, None, cell.path)
    problem = parent.homes.refuses(wanted.method)
    if problem:
        raise StartFailed(cell.path, problem)
    spec = recipe_spec(cell)
    settle_claims(cell, {} if spec is None else spec.bindings)
    if spec is not None and pack_recipe(spec.start, cell.path) == made.recipe:
        cell.spec = dataclasses.replace(spec, mechanism=layers[0] if len(layers) == 1 else layers)
        cell.extra().start = spec.start
    place = None if before is None else before.place
    if before is not None and isinstance(place, GroupPlace) and describe(place.layers) == describe(layers):
        place.home.method = wanted.method
        return before
    return protected_host(parent.homes, wanted.method, layers, parent)


def known(description: Description) -> Mechanism:
    """The mechanism that is meant, if its code is here already: nothing is imported for an actor process.

    Raises:
        MechanismRefused: it is not.
    """
    for kind in (description.kind, *(code.kind for _, _, code in description.bricks)):
        module = kind.partition(":")[0]
        if module not in sys.modules and module not in COMMON:
            why = "the root has not loaded it, and loads nothing that an actor process names: import it there"
            raise MechanismRefused(kind, why)
    whole = Code(description.kind, description.file, description.sha256)
    for code in (whole, *(code for _, _, code in description.bricks)):
        file = getattr(sys.modules.get(code.kind.partition(":")[0]), "__holdfast_file__", ("", ""))
        if code.file and (code.file, code.sha256) != file:
            raise MechanismRefused(code.kind, "the root has not loaded that file, nor does it for a process")
    return revive(description)
