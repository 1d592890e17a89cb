"""The change model (F, A, R): which mechanisms and compositions suit faults, application and resources.

F are the faults that are to be tolerated, A what the application is like, R what there is to run it on. They are looked
at in this order: faults have priority, then the application must have what a mechanism needs, then resources must
suffice. Among those that are left, the cheapest comes first. If none is left, the reasons are the answer; what would
still be covered is told beside, and is nobody's decision but the caller's (T46).

A mechanism is known here by its declaration: class attributes. `declaration.Declaration` says which there are.

Source: Lauer et al. 2018, *Resilient Computing on ROS using Adaptive Fault Tolerance*, section 3 and Table I, extended.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from itertools import product

import msgspec

from .application import Application
from .mechanism_declaration import FAULTS, LAYERS, LEVELS, NEEDS, Cost, Entry, Mechanisms


class FaultClasses(msgspec.Struct, frozen=True):
    """F: the classes of faults that must be tolerated.

    >>> sorted(FaultClasses.of("transient_value", "crash").classes)
    ['crash', 'transient_value']
    """

    classes: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        unknown = self.classes - set(FAULTS)
        if unknown:
            raise ValueError(f"unknown faults {', '.join(sorted(unknown))}; there are {', '.join(FAULTS)}")

    @classmethod
    def of(cls, *classes: str) -> FaultClasses:
        """The faults with these names."""
        return cls(frozenset(classes))

    def __or__(self, other: FaultClasses) -> FaultClasses:
        return FaultClasses(self.classes | other.classes)

    def __str__(self) -> str:
        return ", ".join(name for name in FAULTS if name in self.classes) or "no faults"


class Resources(msgspec.Struct, frozen=True):
    """R: what there is.

    Args:
        units: processing units that fail independently of each other.
        bandwidth: bytes per second between them that may be used.
        cpu: the part of one unit's time that is left on each, 0 to 1; how much of that a request takes depends on the
            application's `rate` and `turn_seconds`.
        energy: what is left of the battery, 0 to 1; 1 on mains.
        certificates: whether there is a certification authority.
    """

    units: int = 1
    bandwidth: float = math.inf
    cpu: float = 1.0
    energy: float = 1.0
    certificates: bool = False

    def scaled(self, factor: float) -> Resources:
        """Return that many times as much of what is measured; units are counted, not measured."""
        return msgspec.structs.replace(
            self, bandwidth=self.bandwidth * factor, cpu=self.cpu * factor, energy=self.energy * factor
        )


class RefusedStack(msgspec.Struct, frozen=True):
    """A mechanism or composition that is not valid, at which of F, A and R it failed, and why."""

    layers: tuple[str, ...]
    stage: str
    why: str

    def __str__(self) -> str:
        return f"{label(self.layers)}: {self.why} ({self.stage})"


class Choice(msgspec.Struct, frozen=True):
    """A valid mechanism or composition (`layers`, outermost first; none: unprotected), with what it costs.

    `price` is the one number by which choices are put in order. `bytes_per_second` goes between units, `load` is the
    part of the busiest unit's time that it takes.
    """

    layers: tuple[str, ...]
    price: float
    units: int
    bandwidth: str
    cost: Cost
    bytes_per_second: float
    load: float
    uncovered: frozenset[str] = frozenset()

    def __str__(self) -> str:
        return label(self.layers)


class Selection(msgspec.Struct, frozen=True):
    """What `select` found: valid choices, cheapest first; the others with their reasons.

    `degraded`: if nothing is valid, what would cover most of the faults, with those it leaves `uncovered`. To take one
    of these is to give up a property, so nobody does it silently.
    """

    faults: FaultClasses
    valid: tuple[Choice, ...]
    refused: tuple[RefusedStack, ...]
    degraded: tuple[Choice, ...] = ()

    @property
    def best(self) -> Choice | None:
        """The cheapest of the valid choices."""
        return self.valid[0] if self.valid else None

    def explain(self) -> str:
        """The whole answer in words."""
        lines = [f"against {self.faults}:"]
        lines += [f"  {choice} (price {choice.price:.3g})" for choice in self.valid]
        if not self.valid:
            lines.append("  nothing is valid")
            lines += [f"  {refusal}" for refusal in self.refused]
            lines += [f"  degraded: {one}, without {FaultClasses(one.uncovered)}" for one in self.degraded[:1]]
        return "\n".join(lines)


Pricing = Callable[[Cost, int, float, float], float]
"""(cost, units, bytes per second, load) -> price; the least is the best."""


def resource_price(cost: Cost, units: int, bytes_per_second: float, load: float) -> float:
    """The smallest set of resources: units first, then computation and energy, then what is sent, then time."""
    return 10.0 * units + cost.total + load + math.log10(1.0 + bytes_per_second) / 10 + cost.latency / 10


def response_price(cost: Cost, units: int, bytes_per_second: float, load: float) -> float:
    """The shortest time to the reply; resources decide among equals."""
    return 1000.0 * cost.latency + 200.0 * cost.states + resource_price(cost, units, bytes_per_second, load)


def recovery_price(cost: Cost, units: int, bytes_per_second: float, load: float) -> float:
    """The shortest time without service after a fault; resources decide among equals."""
    return 1e6 * cost.recovery + resource_price(cost, units, bytes_per_second, load)


SCARCE = 0.5
"""Below this part of the battery, computations are dear."""
PER_COMPUTATION = 100.0
"""What one computation per request costs more in any price, at half of `SCARCE`."""


def energy_price(cost: Cost, energy: float) -> float:
    """What is added to any price when the battery runs low: what computes least lasts longest.

    >>> energy_price(Cost(total=2), 1.0), energy_price(Cost(total=2), 0.25)
    (0.0, 200.0)
    """
    return PER_COMPUTATION * cost.total * max(0.0, SCARCE / max(energy, 0.001) - 1.0)


# -- nesting ---------------------------------------------------------------------------------------------------------


def label(layers: Iterable[str]) -> str:
    """How a composition is written.

    >>> label(("sec", "pbr", "tr")), label(())
    ('sec+pbr+tr', 'unprotected')
    """
    return "+".join(layers) or "unprotected"


def nesting_problems(layers: Mechanisms) -> tuple[str, ...]:
    """What is wrong with the order of a composition, outermost first; empty if nothing is (A64 to A66, T42)."""
    entries = [Entry.of(layer) for layer in layers]
    problems: list[str] = []
    for at, inner in enumerate(entries):
        for outer in entries[:at]:
            problem = _pair_problem(outer, inner)
            if problem:
                problems.append(problem)
        inside = {entry.layer for entry in entries[at + 1 :]}
        if inner.over and not inner.over & inside:
            below = " or ".join(sorted(inner.over))
            problems.append(f"{inner.name} stands over a mechanism of {below}, and there is none inside")
    return tuple(problems)


def _pair_problem(outer: Entry, inner: Entry) -> str:
    # What masks nothing, such as an audit, goes with all.
    masks, replicates = bool(outer.tolerates and inner.tolerates), min(outer.replicas, inner.replicas) > 1
    if outer.layer == inner.layer and (outer.name == inner.name or masks or replicates):
        return f"{outer.name} and {inner.name} are both of {inner.layer}: two of them would work against each other"
    if 1 < outer.replicas != inner.replicas > 1:
        return f"{outer.name} keeps {outer.replicas} replicas, and {inner.name} {inner.replicas}"
    if LAYERS.index(outer.layer) <= LAYERS.index(inner.layer):
        return ""
    if inner.layer == "link":
        return f"{inner.name} must be outermost: outside of it, {outer.name} would see ciphered data"
    if outer.layer == "repetition":
        return f"{outer.name} must stand inside {inner.name}: outside, each of its runs would be a request of its own"
    return f"{inner.name} must stand outside {outer.name}: its assertions are about what the replicas have come to"


# -- selection -------------------------------------------------------------------------------------------------------


def select(
    faults: FaultClasses,
    application: Application,
    resources: Resources,
    mechanisms: Mechanisms | None = None,
    *,
    price: Pricing = resource_price,
) -> Selection:
    """The valid mechanisms and compositions, cheapest first, or none, with the reasons.

    A composition is not offered if it covers the faults without one of its layers. To tolerate no fault, nothing is
    needed: then the best is to be unprotected.

    Args:
        faults: F.
        application: A.
        resources: R.
        mechanisms: declarations of those there are; the built-in ones if not given.
        price: what is cheap: `resource_price`, `response_price`, `recovery_price`, or a user's own. When less than half
            of the battery is left, `energy_price` comes on top of it.
    """
    compositions = _compositions([Entry.of(one) for one in (built_in() if mechanisms is None else mechanisms)])
    valid: list[Choice] = []
    refused: list[RefusedStack] = []
    partial: list[Choice] = []
    for entries in compositions:
        refusal = _refusal(entries, faults, application, resources)
        if refusal is None:
            if not _has_needless(entries, faults):
                valid.append(_choice(entries, faults, application, price, resources.energy))
            continue
        refused.append(refusal)
        if refusal.stage == "F" and _refusal(entries, FaultClasses(), application, resources) is None:
            choice = _choice(entries, faults, application, price, resources.energy)
            if not _has_needless(entries, FaultClasses(faults.classes - choice.uncovered)):
                partial.append(choice)
    valid.sort(key=lambda choice: (choice.price, choice.layers))
    partial.sort(key=lambda choice: (len(choice.uncovered), choice.price, choice.layers))
    return Selection(faults, tuple(valid), tuple(refused), () if valid else tuple(partial))


def check(
    layers: Mechanisms, faults: FaultClasses, application: Application, resources: Resources
) -> tuple[RefusedStack, ...]:
    """Why one composition is not valid for (F, A, R): all reasons, in the order in which they count; none if it is."""
    entries = [Entry.of(layer) for layer in layers]
    names = tuple(entry.name for entry in entries)
    reasons = [RefusedStack(names, "nesting", problem) for problem in nesting_problems(entries)]
    for stage, problems in (
        ("F", _fault_problems(entries, faults)),
        ("A", _application_problems(entries, application, resources)),
        ("R", _resource_problems(entries, application, resources)),
    ):
        reasons += [RefusedStack(names, stage, problem) for problem in problems]
    return tuple(reasons)


def choice_of(
    layers: Mechanisms,
    faults: FaultClasses,
    application: Application,
    *,
    price: Pricing = resource_price,
    energy: float = 1.0,
) -> Choice:
    """What one composition costs, valid or not, with this part of the battery left."""
    return _choice(tuple(Entry.of(layer) for layer in layers), faults, application, price, energy)


def built_in() -> Mechanisms:
    """The declarations that come with the package."""
    from .coverage import built_in_mechanisms

    return built_in_mechanisms()


def _compositions(entries: list[Entry]) -> list[tuple[Entry, ...]]:
    """All compositions that are nested rightly, the empty one among them."""
    kinds = [[None, *(entry for entry in entries if entry.layer == layer)] for layer in LAYERS]
    made = (tuple(entry for entry in chosen if entry is not None) for chosen in product(*kinds))
    return sorted((one for one in made if not nesting_problems(one)), key=len)


def _refusal(
    entries: tuple[Entry, ...], faults: FaultClasses, application: Application, resources: Resources
) -> RefusedStack | None:
    """The first stage at which it fails, with all reasons of that stage."""
    reasons = check(entries, faults, application, resources)
    if not reasons:
        return None
    stage = reasons[0].stage
    return RefusedStack(reasons[0].layers, stage, "; ".join(reason.why for reason in reasons if reason.stage == stage))


def _fault_problems(entries: Sequence[Entry], faults: FaultClasses) -> list[str]:
    missing = faults.classes - _covered(entries)
    return [f"does not tolerate {FaultClasses(missing)}"] if missing else []


def _covered(entries: Sequence[Entry]) -> frozenset[str]:
    return frozenset[str]().union(*(entry.tolerates for entry in entries))


def _has_needless(entries: tuple[Entry, ...], faults: FaultClasses) -> bool:
    """Whether it would do without one of its layers."""
    for at in range(len(entries)):
        rest = (*entries[:at], *entries[at + 1 :])
        if faults.classes <= _covered(rest) and not nesting_problems(rest):
            return True
    return False


def _application_problems(entries: Sequence[Entry], application: Application, resources: Resources) -> list[str]:
    problems: list[str] = []
    for entry in entries:
        for need in (need for need in NEEDS if need in entry.needs):
            if need == "certificates":
                lack = "" if resources.certificates else "there is no certification authority"
            else:
                lack = application.lack(need)
            if lack:
                problems.append(f"{entry.name} needs {need.replace('_', ' ')}: {lack}")
    return problems


def _resource_problems(entries: Sequence[Entry], application: Application, resources: Resources) -> list[str]:
    problems: list[str] = []
    units, cost = _units(entries), _combined(entries)
    if units > resources.units:
        problems.append(f"needs {units} processing units, and has {resources.units}")
    sent, load = _bytes_per_second(cost, application), _load(cost, application)
    if sent > resources.bandwidth:
        problems.append(f"sends {sent:.3g} bytes/s between units, {resources.bandwidth:.3g} can be had")
    if load > resources.cpu:
        problems.append(f"takes {load:.3g} of a unit's time, {resources.cpu:.3g} is left")
    problems += [
        f"{entry.name} needs {entry.least_energy:.0%} of the battery, {resources.energy:.0%} is left"
        for entry in entries
        if entry.least_energy > resources.energy
    ]
    return problems


# -- costs of a composition ------------------------------------------------------------------------------------------


def _units(entries: Sequence[Entry]) -> int:
    """Layers share the replicas there are; versions that want units of their own want them in each replica."""
    shared = max((entry.units for entry in entries if entry.layer != "repetition"), default=1)
    return shared * max((entry.units for entry in entries if entry.layer == "repetition"), default=1)


def _combined(entries: Sequence[Entry]) -> Cost:
    """Computations multiply: what repeats does so in every replica. What is sent adds up."""
    costs = [entry.cost for entry in entries]
    return Cost(
        runs=math.prod(cost.runs for cost in costs),
        latency=math.prod(cost.latency for cost in costs),
        total=math.prod(cost.total for cost in costs),
        states=sum(cost.states for cost in costs),
        requests=sum(cost.requests for cost in costs),
        recovery=max((cost.recovery for cost in costs), default=0.0),
    )


def _bytes_per_second(cost: Cost, application: Application) -> float:
    per_request = cost.states * application.saved_bytes + cost.requests * application.request_bytes
    return application.rate * per_request


def _load(cost: Cost, application: Application) -> float:
    return cost.runs * application.rate * application.turn_seconds


def _choice(
    entries: tuple[Entry, ...], faults: FaultClasses, application: Application, price: Pricing, energy: float
) -> Choice:
    cost, units = _combined(entries), _units(entries)
    sent, load = _bytes_per_second(cost, application), _load(cost, application)
    words = [entry.bandwidth for entry in entries]
    return Choice(
        layers=tuple(entry.name for entry in entries),
        price=price(cost, units, sent, load) + energy_price(cost, energy),
        units=units,
        bandwidth=max(words, key=LEVELS.index, default="nil"),
        cost=cost,
        bytes_per_second=sent,
        load=load,
        uncovered=faults.classes - _covered(entries),
    )
