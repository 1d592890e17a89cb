"""Limits of properties, given by names of components or patterns, that follow the components as the system changes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase
from typing import Final

import msgspec

from ..actors.kernel.actor import Start
from ..actors.kernel.cell import Cell
from ..actors.kernel.node import Node
from ..supervision.spec import ChildSpec
from .assembly import observer
from .generate import replace
from .literals import near, ok
from .model import Declaration, Expectation
from .observers import Bound, Limits, Manner, Property, PropertyObserver

LimitsOf = Mapping[str, Mapping[Property, Limits]]
"""What is good, for each property of some components; they are named, or by a pattern such as `desk/*`."""

_OF_PATTERNS: Final = frozenset("*?[")


class LiveLimits:
    """Holds which components have limits at the moment, and which.

    A name stands for whoever has it, a pattern for all that it fits and that have no limits by name. Limits go with an
    actor that is moved to another supervisor, and so gets another name, unless there are others for that name.

    Attributes:
        applied: component to its limits.
        bounds: component to the same, as a `PropertyObserver` goes by it.
    """

    def __init__(self, given: LimitsOf) -> None:
        self._given = given
        self._cells: dict[str, Cell] = {}
        self.applied: dict[str, Mapping[Property, Limits]] = {}
        self.bounds: dict[str, tuple[Bound, ...]] = {}

    def check(self, components: Iterable[str]) -> None:
        """Refuse a name that no component has: one that comes later is meant by a pattern. Raises ValueError."""
        known = set(components)
        for name in self._given:
            if name not in known and _OF_PATTERNS.isdisjoint(name):
                raise ValueError(
                    f"limits are given for {name!r}, and no component has that name{near(name, known)}; for one that "
                    "comes later give them by a pattern, such as 'desk/*'"
                )

    def look_again(self, addresses: Mapping[str, str]) -> dict[str, Mapping[Property, Limits]]:
        """Say which limits are to be applied now. `addresses`: component to address, as the system is now."""
        components = {path: component for component, path in addresses.items()}
        brought = {
            components[cell.path]: self.applied[component]
            for component, cell in self._cells.items()
            if cell.path in components
        }
        found: dict[str, Mapping[Property, Limits]] = {}
        for component in addresses:
            limits = self._given.get(component, brought.get(component) or self._by_pattern(component))
            if limits:
                found[component] = limits
        return found

    def use(self, found: Mapping[str, Mapping[Property, Limits]], node: Node, addresses: Mapping[str, str]) -> None:
        """Have observers go by these limits from their next look on."""
        cells = {component: node.find(addresses[component]) for component in found}
        self._cells = {component: cell for component, cell in cells.items() if cell is not None}
        self.applied = dict(found)
        replace(self.bounds, {component: _bounds(component, limits) for component, limits in found.items()})

    def _by_pattern(self, component: str) -> Mapping[Property, Limits] | None:
        fitting = (limits for name, limits in self._given.items() if fnmatchcase(component, name))
        return next(fitting, None)


def expecting(declaration: Declaration, limits: LimitsOf) -> Declaration:
    """Return the declaration again, with limits that properties of components are expected to keep."""
    atoms = [(component, str(ok(_property(component, one)))) for component, some in limits.items() for one in some]
    more = tuple(Expectation(atom, (component,)) for component, atom in atoms)
    return msgspec.structs.replace(declaration, expectations=(*declaration.expectations, *more))


def property_observers(
    limits: LimitsOf, addresses: Mapping[str, str], manner: Manner | None = None
) -> Iterable[ChildSpec]:
    """Describe the observer of all properties with limits. Raises KeyError: a component without an address."""
    bounds = {component: _bounds(component, some) for component, some in limits.items()}
    actors = {component: addresses[component] for component in limits}
    return (observe_bounds(bounds, actors, manner),)


def observe_bounds(
    bounds: Mapping[str, tuple[Bound, ...]], actors: Mapping[str, str], manner: Manner | None
) -> ChildSpec:
    """Describe an observer of bounds that may change, of components whose addresses may change."""
    return observer("properties", Start(PropertyObserver, (bounds, actors), {"manner": manner}))


def _bounds(component: str, limits: Mapping[Property, Limits]) -> tuple[Bound, ...]:
    return tuple(Bound(ok(_property(component, one)), one, good) for one, good in limits.items())


def _property(component: str, one: Property) -> str:
    return f"{component}.{one.value}"
