"""What the campaign strikes with: at which steps of a request each kind of fault can happen, and who claims to mask it.

Steps are those of A44-A59: from the proxy through the replica that leads and back, and through the others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from holdfast.ftm.model.mechanism import Mechanism
from holdfast.ftm.replica.replica import nested
from tests.ftm.injection import READ, REQUEST, Fault

Layers = Sequence[Mechanism]
Step = tuple[str, str, bool]
"""Slot, message, whether it is a brick (and so may crash by itself)."""


# -- steps ------------------------------------------------------------------------------------------------------------


def names_of(layers: Layers) -> list[str]:
    """As they are woven: assertions stand inside replication."""
    return [one.name for one in nested(tuple(layers))]


def way(layers: Layers) -> list[Step]:
    """The steps of a request through the replica that leads (A44-A53)."""
    names = names_of(layers)
    is_secured = names[0] == "sec"
    entry, rest = ("Opened", names[1:]) if is_secured else ("Work", names)
    steps: list[Step] = [("protocol", "Sealed", True), ("sec.before", "Sealed", True)] if is_secured else []
    steps.append(("protocol", entry, True))
    inner = [name for name in rest if name != names[0]]
    for name in rest:
        steps += [(f"{name}.protocol", "Work", True)] if name in inner else []
        steps.append((f"{name}.before", "Work", True))
    steps += [("proceed", "Work", True), ("server", REQUEST, False)]
    for name in reversed(rest):
        steps.append((f"{name}.after", "Done", True))
        steps += [(f"{name}.protocol", "Done", True)] if name in inner else []
    steps += [("state", "Capture", True)] if "pbr" in names else []
    steps.append(("protocol", "Done", True))
    return steps + ([("sec.after", "Done", True)] if is_secured else [])


def far(layers: Layers) -> list[Step]:
    """The steps on the other replicas (A52-A54)."""
    names = names_of(layers)
    if "pbr" in names:
        return [("pbr.after", "Letter", True), ("state", "Apply", True)]
    if "tmr" in names:
        return [("tmr.before", "Letter", True), ("server", REQUEST, False)]
    if "lfr" not in names:
        return []
    inner = [
        (f"{name}.{part}", what, True) for name in names[1:] for part, what in (("before", "Work"), ("after", "Done"))
    ]
    ends: list[Step] = [("lfr.before", "Letter", True), ("proceed", "Work", True), ("server", REQUEST, False)]
    return [*ends, *inner, ("lfr.after", "Letter", True)]


def at_each(action: str, layers: Layers, *, bricks_only: bool = False) -> list[Fault]:
    """Before and after each step, in the replica that leads and in another."""
    faults = [
        Fault(action, slot, message, when, leads=leads)
        for leads, steps in ((True, way(layers)), (False, far(layers)))
        for slot, message, is_brick in steps
        if is_brick or not bricks_only
        for when in ("before", "after")
    ]
    if bricks_only:
        faults += [
            Fault(action, "beat", "Tick", "after", leads=leads) for leads in (True, False) if leads or far(layers)
        ]
    return faults


def between(action: str, layers: Layers) -> list[Fault]:
    """On the way to each brick."""
    return [
        Fault(action, slot, message, leads=leads)
        for leads, steps in ((True, way(layers)), (False, far(layers)))
        for slot, message, is_brick in steps
        if is_brick
    ]


def waiting(layers: Layers) -> list[Fault]:
    """The protected actor's turn waits for what never comes, in the replica that leads and where another computes."""
    others = ("server", REQUEST, False) in far(layers)
    return [Fault("wait", "server", REQUEST, leads=leads) for leads in (True, False) if leads or others]


def of_joining(action: str, layers: Layers) -> list[Fault]:
    """While a replica is told that it follows, and is brought to the state."""
    first = "Sealed" if names_of(layers)[0] == "sec" else "Follow"
    return [
        Fault(action, "protocol", message, when, leads=False)
        for message in (first, "Letter")
        for when in ("before", "after")
    ]


def of_root(layers: Layers) -> list[Fault]:
    """What stands in the root: its own death, at what it does."""
    heard = "Sealed" if names_of(layers)[0] == "sec" else "Done"
    parts = [
        ("proxy", "SendNext"),
        ("proxy", heard),
        ("detector", "ReplicaBeat"),
        ("failover", "LookAgain"),
        ("join", "LookAgain"),
    ]
    return [Fault("raise", *part, when) for part in parts for when in ("before", "after")]


def on_links(action: str, layers: Layers) -> list[Fault]:
    """On the links that a mechanism secures: between proxy and replica, both ways, and between replicas."""
    names = names_of(layers)
    if names[0] != "sec":
        return []
    links = [Fault(action, "protocol", "Sealed", leads=True), Fault(action, "proxy", "Sealed")]
    letters = {"pbr": "pbr.after", "lfr": "lfr.before", "tmr": "tmr.before"}
    return [*links, *(Fault(action, letters[name], "Letter", leads=False) for name in names if name in letters)]


def everywhere(layers: Layers) -> list[Fault]:
    """A fault of the protected class itself."""
    return [Fault("answer", "server", READ, "after", permanent=True, everywhere=True)] * 2


KINDS: dict[str, Callable[[Layers], list[Fault]]] = {
    "nothing": lambda layers: [],
    "crash of a replica": lambda layers: at_each("crash", layers),
    "crash of a brick": lambda layers: at_each("raise", layers, bricks_only=True),
    "crash while joining": lambda layers: of_joining("crash", layers) + of_joining("raise", layers),
    "crash of a root part": of_root,
    "hang": lambda layers: at_each("hang", layers),
    "turn without an end": lambda layers: waiting(layers) * 3,
    "SIGSTOP": lambda layers: at_each("stop", layers),
    "SIGSTOP, wake-up": lambda layers: at_each("stop", layers),
    "message delayed": lambda layers: between("delay", layers),
    "message doubled": lambda layers: between("double", layers),
    "message reordered": lambda layers: between("reorder", layers),
    "message lost": lambda layers: between("lose", layers),
    "answer, transient": lambda layers: [Fault("answer", "server", READ, "after")] * 6,
    "state, transient": lambda layers: [Fault("state", "server", REQUEST, "after")] * 6,
    "message, transient": lambda layers: [Fault("message", "proceed", "Work", leads=True)] * 6,
    "answer, permanent": lambda layers: [Fault("answer", "server", READ, "after", permanent=True)] * 2,
    "state, permanent": lambda layers: [Fault("state", "server", REQUEST, "after", permanent=True)] * 2,
    "bug of the class": everywhere,
    "frame lost": lambda layers: on_links("lose", layers),
    "frame delayed": lambda layers: on_links("delay", layers),
    "frame reordered": lambda layers: on_links("reorder", layers),
    "frame altered": lambda layers: on_links("alter", layers),
    "frame replayed": lambda layers: on_links("double", layers),
    "frame forged": lambda layers: on_links("forge", layers),
}
CRASHES = frozenset(kind for kind in KINDS if kind.startswith(("crash", "hang", "turn", "SIGSTOP")))
FRAMES = frozenset(kind for kind in KINDS if kind.startswith("frame"))
LATE = frozenset({"message delayed", "message doubled", "message reordered"})
VALUES = frozenset(kind for kind in KINDS if kind.endswith(("transient", "permanent", "class")))
COPIES = frozenset({"ad", "rb", "nvp", "tmr", "retry"})
"""Mechanisms that keep a request as it came in, or check outcomes against it: it may go wrong inside."""


# -- what is claimed --------------------------------------------------------------------------------------------------


def claims(layers: Layers, kind: str) -> bool:
    """Whether this composition says that it masks such a fault."""
    tolerates = frozenset[str]().union(*(one.tolerates for one in layers))
    if kind == "nothing" or kind in LATE or kind == "crash of a root part":
        return True
    if kind in FRAMES:
        return "forgery" in tolerates
    if kind in CRASHES:
        return "crash" in tolerates
    if kind == "message, transient":
        return bool(COPIES.intersection(names_of(layers)))
    if kind.endswith("transient"):
        return bool({"transient_value", "permanent_value"} & tolerates)
    if kind == "bug of the class":
        return "development" in tolerates
    return kind.endswith("permanent") and "permanent_value" in tolerates


def makes_sense(layers: Layers, kind: str, workload: str = "counter") -> bool:
    """Whether there is such a fault here: one replica alone has no other, and not all have links to be secured."""
    if max(one.replicas for one in layers) < 2 and kind in (CRASHES | {"message lost"}) - {"crash of a root part"}:
        return False  # What it knows would be gone with it.
    if kind == "message, transient" and workload != "counter":
        return False  # No assertion could see that another sum was meant.
    return kind == "nothing" or bool(KINDS[kind](layers))
