"""Children of a supervisor in another process that live at the root: in a group, or in their own process.

The supervisor in the process wants a life; it is lived by processes of the root as always. The death of a replica does
not concern that supervisor. It hears of the end of the life, and decides what follows. When
its process dies, the life ends with it; the home keeps what it holds until the subtree has been started again.
"""

from __future__ import annotations

import dataclasses
import sys
from typing import TYPE_CHECKING

import msgspec

from ...actors.errors import SpecError, StartFailed
from ...actors.kernel.address_host import AddressHost
from ...actors.kernel.bindings import settle_claims
from ...actors.process.process_host import FLIGHT, WorkerHome, WorkerPlace
from ...actors.process.resource_limits import Limits
from ...actors.process.wire.start_codec import pack_recipe
from ...checkpoint.home.journal_home import JournalHome
from ...supervision.respec import recipe_spec
from ..group.group_place import GroupPlace, protected_host
from ..group.transient_homes import is_unkept
from ..model.composition import check_stack, describe
from ..model.mechanism import COMMON, Code, Description, Mechanism, MechanismRefused, revive

if TYPE_CHECKING:
    from ...actors.kernel.cell import Cell, Host
    from ...checkpoint.places.far_parent import FarParent
    from ...checkpoint.protocol import Wanted


def life_at_root(parent: FarParent, cell: Cell, wanted: Wanted, before: Host) -> AddressHost:
    """The host of the life that is wanted: that of the last one, if nothing has changed.

    Raises:
        HoldfastError: it cannot be had.
    """
    made = wanted.at_root
    assert made is not None
    layers = tuple(map(known, msgspec.convert(made.layers, list[Description])))
    if layers:
        check_stack(layers, None, cell.path)
    problem = parent.homes.refuses(wanted.method)
    if problem:
        raise StartFailed(cell.path, problem)
    spec = recipe_spec(cell)
    settle_claims(cell, {} if spec is None else spec.bindings)
    if spec is not None and pack_recipe(spec.start, cell.path) == made.recipe:
        mechanism = None if not layers else layers[0] if len(layers) == 1 else layers
        cell.spec = dataclasses.replace(spec, mechanism=mechanism)
        cell.extra().start = spec.start
    if not layers:
        return process_below(parent, wanted, before)
    place = before.place
    if isinstance(before, AddressHost) and isinstance(place, GroupPlace) and describe(place.layers) == describe(layers):
        place.home.method = wanted.method
        return before
    return protected_host(parent.homes, wanted.method, layers, parent)


def process_below(parent: FarParent, wanted: Wanted, before: Host | None) -> AddressHost:
    """The host of a life in a process of its own.

    Raises:
        StartFailed: its limits cannot be.
    """
    made = wanted.at_root
    assert made is not None
    try:
        limits = Limits(**made.limits) if made.limits else None
    except (TypeError, SpecError) as error:
        raise StartFailed(parent.path, f"limits of its process: {error}") from error
    is_recorded = not is_unkept(wanted.method)
    last = None if before is None or not isinstance(before.place, WorkerPlace) else before.home
    if is_recorded:
        home: WorkerHome = last if isinstance(last, JournalHome) else JournalHome(parent.homes, wanted.method, parent)
        assert isinstance(home, JournalHome)
        home.method = wanted.method
    else:
        home = FLIGHT
    return AddressHost(home, WorkerPlace(home, parent, parent.workers, limits), parent)


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
