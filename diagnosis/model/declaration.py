"""The declaration of a system: components, who publishes what from what, and other expectations.

Plain data, and `System`, which collects it. Nothing is checked here but types; `compile_model` checks the whole.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Mapping
from typing import Final

import msgspec

from ..literals import Literal

DEFAULT_PRIOR: Final = 0.01


class Kind(enum.Enum):
    """The paper's five sets of components (D34)."""

    NODE = "N"
    DRIVER = "HN"
    SWITCHED_DRIVER = "SN"
    SWITCHABLE = "SH"
    DEVICE = "H"

    @property
    def is_hardware(self) -> bool:
        """A device, as opposed to software."""
        return self in (Kind.SWITCHABLE, Kind.DEVICE)


class Component(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """One component. `where` says where it was declared, for errors; it takes no part in what the component is."""

    name: str
    kind: Kind = Kind.NODE
    out: dict[str, tuple[str, ...]] = {}
    """The topics it publishes, each with the topics it is made from (`in` of the paper)."""
    on: tuple[str, ...] = ()
    """The devices it drives (`hardware` of the paper)."""
    prior: float = DEFAULT_PRIOR
    """Probability that it is faulty when nothing is known, between 0 and 1."""
    is_implied: bool = True
    """Clauses 1 to 5 are made for it; False if only written clauses speak of it."""
    where: str = ""


class Value(msgspec.Struct, frozen=True):
    """A value within the messages of a topic, whose trend can be observed."""

    name: str
    topic: str
    where: str = ""


class Relation(msgspec.Struct, frozen=True):
    """The trends of two values are alike while both their publishers work."""

    one: tuple[str, str]
    """Component and value."""
    other: tuple[str, str]
    where: str = ""


class Expectation(msgspec.Struct, frozen=True):
    """While all components in `of` work and all atoms in `given` hold, `atom` holds."""

    atom: str
    of: tuple[str, ...]
    given: tuple[str, ...] = ()
    where: str = ""
    is_quiet: bool = False
    """That nobody says anything of the atom says nothing; else the components are unknown meanwhile."""

    def __post_init__(self) -> None:
        msgspec.structs.force_setattr(self, "atom", str(self.atom))  # An atom, or its text.
        msgspec.structs.force_setattr(self, "given", tuple(map(str, self.given)))


class Clause(msgspec.Struct, frozen=True):
    """A clause as text, `NAB(jn), NAB(ja) -> ok(/odom)`."""

    text: str
    where: str = ""


class Spelling(msgspec.Struct, frozen=True):
    """How written clauses spell the AB predicate, its negation, and any other negation (D29)."""

    ab: str = "AB"
    nab: str = "NAB"
    neg_prefix: str = "not_"


class Declaration(msgspec.Struct, frozen=True, kw_only=True):
    """A whole model as it was declared."""

    components: tuple[Component, ...] = ()
    values: tuple[Value, ...] = ()
    relations: tuple[Relation, ...] = ()
    expectations: tuple[Expectation, ...] = ()
    clauses: tuple[Clause, ...] = ()
    propositions: tuple[str, ...] = ()
    """Atoms that exist though no component accounts for them, such as a topic that comes from outside."""
    spelling: Spelling = Spelling()
    where: str = ""


class System:
    """Collects a declaration, in any order.

    >>> robot = System()
    >>> robot.hardware("ja")
    >>> robot.driver("jn", on=["ja"], out=["/odom"])
    >>> robot.node("nav", out={"/plan": ["/odom"]})
    >>> [component.kind.value for component in robot.declaration().components]
    ['SH', 'SN', 'N']
    """

    def __init__(self) -> None:
        self._components: list[Component] = []
        self._values: list[Value] = []
        self._relations: list[Relation] = []
        self._expectations: list[Expectation] = []
        self._clauses: list[Clause] = []
        self._propositions: list[str] = []

    def hardware(self, *names: str, switchable: bool = True, prior: float = DEFAULT_PRIOR) -> None:
        """Devices; `switchable` if their power can be switched (and `on(h)` be observed)."""
        kind = Kind.SWITCHABLE if switchable else Kind.DEVICE
        self._components += (Component(name=name, kind=kind, prior=prior) for name in names)

    def driver(
        self,
        name: str,
        *,
        on: Iterable[str] = (),
        out: Iterable[str] | Mapping[str, Iterable[str]] = (),
        prior: float = DEFAULT_PRIOR,
    ) -> None:
        """Software that drives the devices `on`, if they are part of the model."""
        # The kind follows from the kinds of its devices, which may be declared later: `declaration` settles it.
        made = Component(name=name, kind=Kind.DRIVER, on=tuple(on), out=outputs(out), prior=prior)
        self._components.append(made)

    def node(
        self, name: str, *, out: Iterable[str] | Mapping[str, Iterable[str]] = (), prior: float = DEFAULT_PRIOR
    ) -> None:
        """Other software: what it publishes, each topic with the topics it is made from."""
        self._components.append(Component(name=name, out=outputs(out), prior=prior))

    def value(self, topic: str, *names: str) -> None:
        """Values in the messages of a topic, for `inc`, `dec`, `const` and `matched`."""
        self._values += (Value(name, topic) for name in names)

    def related(self, one: tuple[str, str], other: tuple[str, str]) -> None:
        """Two (component, value) whose trends are alike."""
        self._relations.append(Relation(one, other))

    def expect(self, atom: Literal | str, *, of: Iterable[str], given: Iterable[Literal | str] = ()) -> None:
        """`atom` (such as `ok(memory)`) holds while the components `of` work and the atoms `given` hold."""
        self._expectations.append(Expectation(str(atom), tuple(of), tuple(map(str, given))))

    def clause(self, text: str) -> None:
        """A Horn clause of any other form, such as `NAB(a), ok(/x) -> ok(/y)`."""
        self._clauses.append(Clause(text))

    def external(self, *topics: str) -> None:
        """Topics that come from outside the model."""
        self._propositions += (f"ok({topic})" for topic in topics)

    def proposition(self, *atoms: Literal | str) -> None:
        """Further atoms that may be observed and used in clauses."""
        self._propositions += map(str, atoms)

    def declaration(self) -> Declaration:
        """Return all that was collected so far, as plain data."""
        return Declaration(
            components=settle_kinds(self._components),
            values=tuple(self._values),
            relations=tuple(self._relations),
            expectations=tuple(self._expectations),
            clauses=tuple(self._clauses),
            propositions=tuple(self._propositions),
        )


def outputs(out: Iterable[str] | Mapping[str, Iterable[str]]) -> dict[str, tuple[str, ...]]:
    """Topics with what they are made from; a plain list of topics is made from nothing."""
    if isinstance(out, str):
        return {out: ()}  # one topic; its letters are surely not meant
    if isinstance(out, Mapping):
        return {topic: (inputs,) if isinstance(inputs, str) else tuple(inputs) for topic, inputs in out.items()}
    return dict.fromkeys(out, ())


def settle_kinds(components: Iterable[Component]) -> tuple[Component, ...]:
    """Drivers of switchable devices become `SN`, the others `HN`."""
    found = tuple(components)
    switchable = {component.name for component in found if component.kind is Kind.SWITCHABLE}
    return tuple(_settled(component, switchable) for component in found)


def _settled(component: Component, switchable: set[str]) -> Component:
    if component.kind not in (Kind.DRIVER, Kind.SWITCHED_DRIVER):
        return component
    kind = Kind.DRIVER if switchable.isdisjoint(component.on) else Kind.SWITCHED_DRIVER
    return component if kind is component.kind else msgspec.structs.replace(component, kind=kind)
