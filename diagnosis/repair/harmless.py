"""The part of a plan that need not wait until a person has approved the rest."""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from ..planning import Plan, Problem, Simulator, Step
from ..planning.language import Atom

ADDRESS = "address"
"""Stands before an address among what steps read and write; no predicate is called so."""


def harmless_part(
    problem: Problem, plan: Plan, is_dangerous: Callable[[Step], bool], address: Callable[[Step], str]
) -> Plan:
    """The steps of a plan that neither need a dangerous one, nor are needed by one, nor act at, above or below it.

    Args:
        problem: what the plan is for.
        plan: what is to be done.
        is_dangerous: whether a person has to approve a step.
        address: what a step acts on.

    Returns:
        The whole plan, if nothing of it is dangerous, or nothing harmless.
    """
    writes, reads = _uses(problem, plan, address)
    tied = [step for step in plan.steps if is_dangerous(step)]
    found, seen = set(tied), set[Atom]()
    by_atom: dict[Atom, list[Step]] = {}
    for step in writes:
        for atom in writes[step] | reads[step]:
            by_atom.setdefault(atom, []).append(step)
    written = set[Atom]().union(*writes.values())
    while tied:
        step = tied.pop()
        for atom in (writes[step] | (reads[step] & written)) - seen:
            seen.add(atom)
            more = [one for one in by_atom[atom] if one not in found]
            found.update(more)
            tied += more
    stages = tuple(kept for stage in plan.stages if (kept := tuple(step for step in stage if step not in found)))
    return msgspec.structs.replace(plan, stages=stages) if stages else plan


def _uses(
    problem: Problem, plan: Plan, address: Callable[[Step], str]
) -> tuple[dict[Step, set[Atom]], dict[Step, set[Atom]]]:
    """What each step changes, and on what it depends: the address that it acts on, and those above, are among it."""
    simulator = Simulator(problem)
    writes: dict[Step, set[Atom]] = {}
    reads: dict[Step, set[Atom]] = {}
    for stage in plan.stages:
        effects = {step: simulator.effects(step) for step in stage}
        for step, made in effects.items():
            parts = address(step).split("/")
            above = {(ADDRESS, "/".join(parts[:count])) for count in range(1, len(parts))}
            writes.setdefault(step, set()).update((effect.atom for effect in made), {(ADDRESS, address(step))})
            reads.setdefault(step, set()).update(simulator.reads(step), above)
        for made in effects.values():
            simulator.put(made)
    return writes, reads
