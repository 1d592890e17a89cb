"""The declaration of a mechanism: what it tolerates, needs and costs, and its layer in a composition."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Final

import msgspec

FAULTS: Final = (
    "crash",
    "transient_value",
    "permanent_value",
    "development",
    "eavesdropping",
    "forgery",
    "replay",
)
NEEDS: Final = ("determinism", "state_access", "assertions", "versions", "certificates")
LAYERS: Final = ("link", "assertion", "replication", "repetition")
"""Kinds of mechanisms in the order in which they are nested, outermost first. A composition has one of each at most.

`link` (SEC) is outermost: all others see plain data. `assertion` (A&D) looks at what the replicas have come to.
`replication` (PBR, LFR, TMR) keeps replicas alike. `repetition` (TR, RB, NVP) computes more than once in one replica,
so it stands inside: outside, each of its runs would be replicated as a request of its own.
"""

LEVELS: Final = ("nil", "low", "high")
_LEVEL_STATES: Final = {"nil": 0.0, "low": 0.0, "high": 1.0}
_LEVEL_REQUESTS: Final = {"nil": 0.0, "low": 1.0, "high": 0.0}
_LEVEL_RUNS: Final = {"nil": 0.0, "low": 1.0, "high": 2.0}


class Cost(msgspec.Struct, frozen=True):
    """What a mechanism costs per request, in multiples of what the unprotected application uses.

    Args:
        runs: computations per request on the busiest unit.
        latency: time to the reply, in computations one after the other.
        total: computations per request on all units together.
        states: how often the state goes from one unit to another.
        requests: how often request or reply does.
        recovery: seconds without service after a fault that is tolerated; 0 where it is masked.
    """

    runs: float = 1.0
    latency: float = 1.0
    total: float = 1.0
    states: float = 0.0
    requests: float = 0.0
    recovery: float = 0.0


class MechanismDeclaration:
    """What is read of a mechanism, a class or an instance of one. A declaration has `name`, `tolerates` and `needs`.

    `replicas`, `units`: how many it takes. `layer`: one of `LAYERS`, if it cannot be told from
    its needs and replicas. `over`: layers of which one must stand inside (A&D stands over a duplex). `bandwidth` (nil,
    low, high) and `cpu` (low, high): the words of Table I. `cost`: the numbers beside, made of the words if absent.
    `least_energy`: the part of the battery below which it is not to be used.
    """

    name: ClassVar[str] = ""
    tolerates: ClassVar[frozenset[str]] = frozenset()
    needs: ClassVar[frozenset[str]] = frozenset()
    replicas: ClassVar[int] = 1
    units: ClassVar[int] = 1
    layer: ClassVar[str] = ""
    over: ClassVar[frozenset[str]] = frozenset()
    bandwidth: ClassVar[str] = "nil"
    cpu: ClassVar[str] = "low"
    cost: ClassVar[Cost | None] = None
    least_energy: ClassVar[float] = 0.0


class BadDeclaration(ValueError):
    """A mechanism declares what there is not."""


class Entry(msgspec.Struct, frozen=True):
    """A declaration, read and completed."""

    name: str
    layer: str
    tolerates: frozenset[str]
    needs: frozenset[str]
    units: int
    replicas: int
    bandwidth: str
    cpu: str
    cost: Cost
    over: frozenset[str] = frozenset()
    least_energy: float = 0.0

    @classmethod
    def of(cls, mechanism: MechanismDeclaration | type[MechanismDeclaration] | Entry) -> Entry:
        """Read a declaration.

        Raises:
            BadDeclaration: it names a fault, a need, a layer or a level that there is not.
        """
        if isinstance(mechanism, Entry):
            return mechanism
        name, replicas = mechanism.name, mechanism.replicas
        tolerates, needs = frozenset(mechanism.tolerates), frozenset(mechanism.needs)
        bandwidth, cpu, over = mechanism.bandwidth, mechanism.cpu, frozenset(mechanism.over)
        layer = mechanism.layer or _layer(tolerates, needs, replicas)
        for what, given, known in (
            ("faults", tolerates, FAULTS),
            ("needs", needs, NEEDS),
            ("layers", {layer} | over, LAYERS),
            ("levels of bandwidth", {bandwidth}, _LEVEL_STATES),
            ("levels of CPU", {cpu}, _LEVEL_RUNS),
        ):
            if unknown := set(given) - set(known):
                raise BadDeclaration(
                    f"{name}: unknown {what} {', '.join(map(str, unknown))}; known: {', '.join(known)}"
                )
        cost = mechanism.cost or _cost(layer, bandwidth, cpu, replicas)
        return cls(
            name, layer, tolerates, needs, mechanism.units, replicas, bandwidth, cpu, cost, over, mechanism.least_energy
        )


Mechanisms = Sequence[MechanismDeclaration | type[MechanismDeclaration] | Entry]
"""Declarations: classes of mechanisms or instances of them, or what was read of them."""


def _layer(tolerates: frozenset[str], needs: frozenset[str], replicas: int) -> str:
    if "certificates" in needs or tolerates & {"eavesdropping", "forgery", "replay"}:
        return "link"
    if "assertions" in needs and "versions" not in needs:
        return "assertion"
    return "replication" if replicas > 1 else "repetition"


def _cost(layer: str, bandwidth: str, cpu: str, replicas: int) -> Cost:
    runs = _LEVEL_RUNS[cpu]
    states, requests = _LEVEL_STATES[bandwidth], _LEVEL_REQUESTS[bandwidth]
    if layer == "repetition":
        return Cost(runs=runs, latency=runs, total=runs, states=states, requests=requests)
    # Replicas that all compute do so side by side.
    return Cost(total=runs if replicas < 3 else runs * replicas / 2, states=states, requests=requests)
