"""Chooses which diagnosis to act on, and what to plan for it.

Pure: observations, diagnosis and ledger in, problem out. Of several diagnoses the one is taken that was tried least in
this case; then, that with the fewest components; then, that whose components were touched least; then the first by the
engine's rank. So a diagnosis that did not help is not taken again before the others were (O3). Those of more components
than one that was tried, and explains everything again, are not taken: that a repair has not helped is likelier than
that so many are faulty at once.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Mapping
from typing import NamedTuple

from ..engine import Candidate, Diagnosis, State
from ..literals import Literal
from ..model import Kind, Model
from ..observations import Observed
from ..planning import Problem, repair_problem
from ..planning.language import PlanLiteral as Goal
from .actions import RepairAction, Repertoire
from .ledger import Ledger
from .policy import Policy, Stance


class CaseView(NamedTuple):
    """What repair knows at one moment of a case.

    Attributes:
        diagnosed: when the diagnosis came.
        stood: when the youngest of its symptoms began, as far as its observers know.
        settles: until when no plan is made.
        bad: the candidate to act on.
        given_up: components that are beyond repair.
        stance: how far repair goes.
        is_unsure: something that depends on whom the case has touched is not seen to hold yet.
    """

    diagnosis: Diagnosis
    observed: Observed
    mode: str
    now: float
    diagnosed: float = -math.inf
    settles: float = -math.inf
    bad: tuple[str, ...] | None = None
    given_up: Collection[str] = ()
    stance: Stance = "on"
    is_unsure: bool = False
    stood: float = math.inf


def choose(
    diagnosis: Diagnosis,
    *,
    alone: Collection[str],
    given_up: Collection[str],
    hopeless: Collection[tuple[str, ...]],
    tried: Mapping[tuple[str, ...], int],
    tries: Mapping[str, int],
) -> Candidate | None:
    """The candidate to act on; None if there is none for which anything can be done.

    Args:
        diagnosis: the candidates, best first.
        alone: components to leave alone: excluded, or given up.
        given_up: of these, those that were tried in vain. What they explain alone needs no other explanation.
        hopeless: candidates for which there is no plan.
        tried: plans made for a set of components in this case.
        tries: actions on a component in this case.
    """
    if diagnosis.state is not State.FAULTY:
        return None
    if any(set(one.bad) <= set(given_up) for one in diagnosis.candidates):
        return None
    most = min((len(one.bad) for one in diagnosis.candidates if tried.get(one.bad)), default=math.inf)
    open_ = [
        one
        for one in diagnosis.candidates
        if len(one.bad) <= most and one.bad not in hopeless and not set(one.bad) <= set(alone)
    ]

    def key(one: Candidate) -> tuple[int, int, int]:
        bad = [name for name in one.bad if name not in alone]
        return tried.get(one.bad, 0), len(bad), sum(tries.get(name, 0) for name in bad)

    return min(open_, key=key, default=None)  # The first of equals: the engine's rank.


def problem_for(
    model: Model,
    repertoire: Repertoire,
    policy: Policy,
    ledger: Ledger,
    at: CaseView,
    bad: Collection[str],
    alone: Collection[str],
    is_free: Callable[[RepairAction, str], bool],
) -> Problem:
    """The problem of making `bad` good, without a touch on those to leave alone or on what has no attempts left.

    `is_free` says whether an action reaches nobody at or below a component's address who is to be left alone.
    """
    kinds = {name: component.kind for name, component in model.components.items()}
    hardware = [name for name, kind in kinds.items() if kind is Kind.SWITCHABLE]
    nodes = [name for name, kind in kinds.items() if not kind.is_hardware]
    drives = {name: [one for one in model.components[name].on if one in set(hardware)] for name in nodes}
    off = {literal.args[0] for literal in at.observed.negative if literal.name in ("on", "running")}
    blamed = [name for name in bad if name in kinds]
    touchable = [name for name in kinds if name not in alone]
    problem = repair_problem(
        repertoire.domain,
        hardware=hardware,
        devices=[name for name, kind in kinds.items() if kind is Kind.DEVICE],
        nodes=nodes,
        drives={name: needed for name, needed in drives.items() if needed},
        bad=blamed,
        on=[name for name in hardware if name not in off],
        running=[name for name in nodes if name not in off],
        optional=[name for name in policy.optional if name in kinds],
        restart_drivers=policy.restart_drivers,
        facts=repertoire.allowed(
            touchable,
            lambda action, name: (
                policy.may(action.name, at.mode) and ledger.is_left(action, name, at.now) and is_free(action, name)
            ),
        ),
    )
    # Who is left alone is neither good nor bad: nobody can rely on it, and nobody is to mend it.
    left = {("bad", name) for name in alone}
    goals = [goal for goal in problem.goals if goal.atom[1] not in alone]
    return dataclasses.replace(problem, init=problem.init - left, goals=tuple(goals))


def components_of(goals: Collection[Goal]) -> tuple[str, ...]:
    """Who the goals are about."""
    return tuple(dict.fromkeys(goal.atom[1] for goal in goals if len(goal.atom) > 1))


def remaining(symptoms: Collection[Literal], observed: Observed) -> tuple[Literal, ...]:
    """The symptoms that are not seen to have gone: they still are, or nobody says anything of them any more."""
    return tuple(one for one in symptoms if not observed.has_gone(one))


def symptoms_held(symptoms: Collection[Literal], observed: Observed) -> bool:
    """Whether at least one of the symptoms is still observed: a diagnosis is no newer than its observations."""
    return any(one in observed.positive if one.positive else one.atom in observed.negative for one in symptoms)
