"""A model that changes: numbered versions, each checked before it counts, and the way back.

Plain data and pure steps. A change that leads to a model that cannot be used changes nothing.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, TypeAlias

import msgspec

from ...actors.errors import HoldfastError
from .check import Model, ModelError
from .declaration import Clause, Component, Declaration, Expectation, Relation, System, Value

KEPT: Final = 32
"""Versions that are kept to go back to."""


class Put(msgspec.Struct, frozen=True, tag=True):
    """Add a component, or declare the one of that name anew."""

    component: Component


class Remove(msgspec.Struct, frozen=True, tag=True):
    """Remove a component, with the relations it takes part in."""

    component: str


class Relate(msgspec.Struct, frozen=True, tag=True):
    """Add a relation; the values in `values` are declared with it."""

    relation: Relation
    values: tuple[Value, ...] = ()


class Expect(msgspec.Struct, frozen=True, tag=True):
    """Adds an expectation to the model."""

    expectation: Expectation


class Add(msgspec.Struct, frozen=True, tag=True):
    """Adds a clause to the model, as it is written."""

    clause: Clause


class Drop(msgspec.Struct, frozen=True, tag=True):
    """Remove a written clause, by its text, or an expectation or proposition, by its atom."""

    text: str


class Declare(msgspec.Struct, frozen=True, tag=True):
    """Adds propositions that clauses may use."""

    propositions: tuple[str, ...]


class Replace(msgspec.Struct, frozen=True, tag=True):
    """Puts another model in the place of the whole model."""

    declaration: Declaration


Change: TypeAlias = Put | Remove | Relate | Expect | Add | Drop | Declare | Replace


class Version(msgspec.Struct, frozen=True):
    """One version: its number, what it says, and why it was made."""

    number: int
    declaration: Declaration
    reason: str = ""
    time: float = 0.0


class NoSuchVersion(HoldfastError, text="there is no version {version} of the model; kept are {kept:, }"):
    """A version that never was, or that is not kept any more."""

    version: int
    kept: tuple[int, ...]


class History:
    """The versions of one model, the newest of which counts. Numbers only rise, also when going back.

    >>> robot = System()
    >>> robot.node("a")
    >>> history = History(robot)
    >>> history.change([Put(Component(name="b"))], "b was plugged in").version
    2
    >>> back = history.roll_back(1)
    >>> back.version, list(back.components)
    (3, ['a'])
    """

    def __init__(self, first: Declaration | System, reason: str = "first", time: float = 0.0) -> None:
        self.model = Model(first)
        self._versions = [Version(1, self.model.declaration, reason, time)]

    @property
    def versions(self) -> tuple[Version, ...]:
        """Those that are kept, oldest first."""
        return tuple(self._versions)

    def change(self, changes: Iterable[Change], reason: str = "", time: float = 0.0) -> Model:
        """Make all of the changes, or none.

        Raises:
            ModelError: a change does not apply, or the model could not be used after it.
        """
        changed = self.model.declaration
        for change in changes:
            changed = apply(change, changed)
        return self._enter(changed, reason, time)

    def roll_back(self, version: int | None = None, reason: str = "", time: float = 0.0) -> Model:
        """Make the content of an earlier version count again; the one before the newest unless one is named.

        Raises:
            NoSuchVersion: it is not kept.
        """
        wanted = self.model.version - 1 if version is None else version
        for kept in self._versions:
            if kept.number == wanted:
                return self._enter(kept.declaration, reason or f"back to version {wanted}", time)
        raise NoSuchVersion(wanted, tuple(kept.number for kept in self._versions))

    def _enter(self, declaration: Declaration, reason: str, time: float) -> Model:
        self.model = Model(declaration, self.model.version + 1)  # raises before anything is changed
        self._versions.append(Version(self.model.version, self.model.declaration, reason, time))
        del self._versions[:-KEPT]
        return self.model


def apply(change: Change, to: Declaration) -> Declaration:
    """The declaration after one change; it is not checked as a whole.

    Raises:
        ModelError: what is to be removed is not there, or what is to be added is.
    """
    match change:
        case Put(component):
            others = [other for other in to.components if other.name != component.name]
            return msgspec.structs.replace(to, components=(*others, component))
        case Remove(name):
            return _without(name, to)
        case Relate(relation, values):
            new = tuple(value for value in values if value not in to.values)
            return msgspec.structs.replace(to, relations=(*to.relations, relation), values=(*to.values, *new))
        case Expect(expectation):
            return msgspec.structs.replace(to, expectations=(*to.expectations, expectation))
        case Add(clause):
            return msgspec.structs.replace(to, clauses=(*to.clauses, clause))
        case Drop(text):
            return _dropped(text, to)
        case Declare(propositions):
            return msgspec.structs.replace(to, propositions=tuple(dict.fromkeys((*to.propositions, *propositions))))
        case Replace(declaration):
            return declaration


def _without(name: str, to: Declaration) -> Declaration:
    left = tuple(component for component in to.components if component.name != name)
    if len(left) == len(to.components):
        raise ModelError((f"{name} cannot be removed: there is no such component",))
    relations = tuple(one for one in to.relations if name not in (one.one[0], one.other[0]))
    return msgspec.structs.replace(to, components=left, relations=relations)


def _dropped(text: str, to: Declaration) -> Declaration:
    left = msgspec.structs.replace(
        to,
        clauses=tuple(clause for clause in to.clauses if clause.text != text),
        expectations=tuple(one for one in to.expectations if one.atom != text),
        propositions=tuple(atom for atom in to.propositions if atom != text),
    )
    if left == to:
        raise ModelError((f"{text!r} cannot be removed: no clause, expectation or proposition is that",))
    return left
