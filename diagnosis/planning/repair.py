"""Makes a planning problem of repair from a diagnosis and from what was observed.

The initial state is what was observed and who is good and bad; the goal is that all are good. With optional parts and
`find_plan(..., degrade=True)` what is beyond repair is left out.

Source: Zaman, Steinbauer, Maurer, Lepej, Uran 2013, section V, completed (see `repair.pddl`).
"""

from __future__ import annotations

import functools
from collections.abc import Collection, Iterable, Mapping
from importlib.resources import files

from .language import Atom, Domain, PlanLiteral, PlanningError, Problem
from .pddl_reader import read_domain, with_actions


@functools.cache
def repair_text() -> str:
    """The PDDL text of the domain that comes with holdfast."""
    return files(__name__.rpartition(".")[0]).joinpath("repair.pddl").read_text("utf-8")


def repair_domain(*actions: str) -> Domain:
    """The repair domain, with more actions as PDDL text; the same ones are parsed once.

    Raises:
        PlanningError: an action's text is not valid, or there is such an action already.

    >>> effect = ":effect (and (good ?d) (not (bad ?d)))"
    >>> reset = f"(:action reset_usb :parameters (?d - device) :precondition (bad ?d) {effect})"
    >>> [action.name for action in repair_domain(reset).actions]
    ['power_up', 'reset_usb', 'shutdown', 'start_node', 'stop_node']
    """
    return read_domain(with_actions(repair_text(), *actions))


def repair_problem(
    domain: Domain,
    *,
    bad: Collection[str],
    hardware: Collection[str] = (),
    devices: Collection[str] = (),
    nodes: Collection[str] = (),
    drives: Mapping[str, Iterable[str]] | None = None,
    on: Collection[str] = (),
    running: Collection[str] = (),
    optional: Collection[str] = (),
    restart_drivers: bool = False,
    objects: Mapping[str, str] | None = None,
    facts: Iterable[Atom] = (),
) -> Problem:
    """All components are to be good; those that are not `bad` are so now.

    Args:
        domain: `repair_domain()`, perhaps with more actions.
        bad: components that the diagnosis blames.
        hardware: components with a switch.
        devices: hardware without one.
        nodes: components of software.
        drives: for each node the hardware without which it is of no use.
        on: hardware that has power.
        running: nodes that run.
        optional: components that are given up first, when not all can be repaired.
        restart_drivers: what runs and drives a bad device counts as bad: it is stopped and started in the same plan.
            Without this a second diagnosis finds that out.
        objects: further objects and their types, for actions of one's own.
        facts: further atoms that are true.

    Raises:
        PlanningError: a name that is no component, or a component of two kinds.
    """
    kinds = _kinds(hardware, devices, nodes)
    drives = drives or {}
    _known("drives", drives, set(nodes))
    for node, needed in drives.items():
        _known(f"drives[{node!r}]", needed, set(hardware))
    for name, said, among in (
        ("bad", bad, set(kinds)),
        ("on", on, set(hardware)),
        ("running", running, set(nodes)),
        ("optional", optional, set(kinds)),
    ):
        _known(name, said, among)
    faulty = set(bad)
    if restart_drivers:
        faulty |= {node for node, needed in drives.items() if node in set(running) and not faulty.isdisjoint(needed)}
    init: set[Atom] = {("bad", name) if name in faulty else ("good", name) for name in kinds}
    init |= {("on", name) for name in on} | {("running", name) for name in running}
    init |= {("drives", node, name) for node, needed in drives.items() for name in needed}
    ranked = sorted(kinds, key=lambda name: name in set(optional))  # As they were given, otherwise.
    goals = tuple(PlanLiteral(("good", name)) for name in ranked)
    return Problem(domain, {**kinds, **(objects or {})}, frozenset(init) | frozenset(facts), goals)


def _kinds(hardware: Iterable[str], devices: Iterable[str], nodes: Iterable[str]) -> dict[str, str]:
    kinds: dict[str, str] = {}
    for kind, names in (("hardware", hardware), ("device", devices), ("node", nodes)):
        for name in names:
            if kinds.setdefault(name, kind) != kind:
                raise PlanningError(f"component {name}", f"it is {kinds[name]} and {kind}")
    return kinds


def _known(where: str, names: Iterable[str], among: Collection[str]) -> None:
    unknown = sorted(name for name in names if name not in among)
    if unknown:
        raise PlanningError(where, f"there is no such component: {', '.join(unknown)}")
