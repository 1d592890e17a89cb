"""Checks what a plan does by its actions as written, independent of grounding and planner."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from ..engine.breath import breathing
from .answers import Plan, Step
from .language import (
    Action,
    And,
    Atom,
    Exists,
    Fact,
    ForAll,
    Formula,
    Not,
    Or,
    PlanLiteral,
    PlanningError,
    Problem,
    Same,
)
from .static_facts import Binding, StaticFacts, fill

TRUE: Final = And()
"""The condition of an effect that has none."""


class InvalidPlan(PlanningError):
    """A step that cannot be done where it stands, steps of a stage in each other's way, or a goal that is not met."""


class Simulator:
    """The state of a problem's world, changed by steps.

    Attributes:
        state: the atoms that are true.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.state = set(problem.init)
        self._world = StaticFacts.of(problem)
        self._actions = {action.name: action for action in problem.domain.actions}
        self._bound: dict[Step, tuple[Action, Binding]] = {}

    def missing(self, step: Step) -> str:
        """Why the step cannot be done now; empty if it can be. Raises InvalidPlan: there is no such step."""
        action, bound = self._bind(step)
        return self._why_not(action.precondition, bound)

    def do(self, step: Step) -> frozenset[PlanLiteral]:
        """Do it, and say what it has changed.

        Raises:
            InvalidPlan: it cannot be done now.
        """
        missing = self.missing(step)
        if missing:
            raise InvalidPlan(str(step), missing)
        return self.put(self.effects(step))

    def put(self, literals: Iterable[PlanLiteral]) -> frozenset[PlanLiteral]:
        """Make these so (what is made both true and false becomes true), and say what that has changed."""
        made = list(literals)
        before = {atom for atom, _ in made if atom in self.state}
        self.state -= {atom for atom, value in made if not value}
        self.state |= {atom for atom, value in made if value}
        return frozenset(
            PlanLiteral(atom, atom in self.state) for atom, _ in made if (atom in before) is not (atom in self.state)
        )

    def effects(self, step: Step) -> list[PlanLiteral]:
        """What would be so if the step were done now."""
        action, bound = self._bind(step)
        return [
            PlanLiteral(fill(effect.literal.atom, inner), effect.literal.value)
            for effect in action.effects
            for inner in self._world.places(effect, bound)
            if self.holds(effect.condition, inner)
        ]

    def unmet(self) -> tuple[PlanLiteral, ...]:
        """The goals that are not met."""
        return tuple(goal for goal in self.problem.goals if (goal.atom in self.state) is not goal.value)

    def holds(self, formula: Formula, bound: Binding) -> bool:
        """Whether a formula is true now."""
        match formula:
            case Fact(atom):
                return fill(atom, bound) in self.state
            case Same(left, right):
                return bound.get(left, left) == bound.get(right, right)
            case Not(of):
                return not self.holds(of, bound)
            case And(of):
                return all(self.holds(part, bound) for part in of)
            case Or(of):
                return any(self.holds(part, bound) for part in of)
            case ForAll(_, of):
                return all(self.holds(of, inner) for inner in self._world.instances(formula, bound))
            case Exists(_, of):
                return any(self.holds(of, inner) for inner in self._world.instances(formula, bound))

    def reads(self, step: Step) -> set[Atom]:
        """Every atom on which it depends whether the step can be done, and what it does."""
        action, bound = self._bind(step)
        found: set[Atom] = set()
        self._collect(action.precondition, bound, found)
        for effect in action.effects:
            if effect.variables or effect.condition != TRUE:
                self._collect(ForAll(effect.variables, effect.condition), bound, found)
        return found

    def _collect(self, formula: Formula, bound: Binding, found: set[Atom]) -> None:
        match formula:
            case Fact(atom) if atom[0] in self._world.changing:
                found.add(fill(atom, bound))
            case Fact() | Same():
                pass
            case Not(of):
                self._collect(of, bound, found)
            case And(of) | Or(of):
                for part in of:
                    self._collect(part, bound, found)
            case ForAll(_, of) | Exists(_, of):
                for inner in self._world.instances(formula, bound):
                    self._collect(of, inner, found)

    def _why_not(self, formula: Formula, bound: Binding) -> str:
        """The first part of a conjunction that is not true, in words."""
        match formula:
            case And(of):
                return next((why for part in of if (why := self._why_not(part, bound))), "")
            case ForAll(_, of):
                inners = self._world.instances(formula, bound)
                return next((why for inner in inners if (why := self._why_not(of, inner))), "")
            case Or((Not(condition), then)) if self.holds(condition, bound):
                return self._why_not(then, bound)
            case Fact(atom):
                return "" if self.holds(formula, bound) else f"{PlanLiteral(fill(atom, bound))} is not so"
            case Not(Fact(atom)):
                return "" if self.holds(formula, bound) else f"{PlanLiteral(fill(atom, bound))} is so"
            case _:
                return "" if self.holds(formula, bound) else "its precondition is not met"

    def _bind(self, step: Step) -> tuple[Action, Binding]:
        known = self._bound.get(step)
        if known is not None:
            return known
        action = self._actions.get(step.action)
        if action is None:
            raise InvalidPlan(str(step), f"there is no action {step.action}")
        if len(step.args) != len(action.parameters):
            raise InvalidPlan(str(step), f"{step.action} takes {len(action.parameters)} objects")
        for variable, name in zip(action.parameters, step.args, strict=True):
            if not self._world.is_of(name, variable.types):
                raise InvalidPlan(str(step), f"{name} is no {' or '.join(variable.types)}")
        bound = {variable.name: name for variable, name in zip(action.parameters, step.args, strict=True)}
        self._bound[step] = action, bound
        return action, bound


def check_plan(problem: Problem, plan: Plan) -> Simulator:
    """Do a plan, stage by stage; returns the world after it.

    Raises:
        InvalidPlan: a step cannot be done at the beginning of its stage, two steps of a stage are in each other's way,
            or a goal is not met that the plan does not give up.
    """
    simulator = Simulator(problem)
    for stage in plan.stages:
        simulator.put(_check_stage(simulator, stage))
    unmet = [goal for goal in simulator.unmet() if goal not in plan.unmet]
    if unmet:
        raise InvalidPlan("plan", f"it ends without {', '.join(map(str, unmet))}")
    return simulator


def _check_stage(simulator: Simulator, stage: Iterable[Step]) -> list[PlanLiteral]:
    """What the stage makes so. All of it can be done now, and no step writes what another reads or writes otherwise.

    Then any order is as good, and leads to the same.
    """
    steps = list(stage)
    written: dict[PlanLiteral, list[Step]] = {}
    for step in breathing(steps, 64):
        if missing := simulator.missing(step):
            raise InvalidPlan(str(step), missing)
        effects = simulator.effects(step)
        added = {literal.atom for literal in effects if literal.value}
        for atom in {literal.atom for literal in effects}:
            written.setdefault(PlanLiteral(atom, atom in added), []).append(step)
    for (atom, value), writers in written.items():
        if undoing := written.get(PlanLiteral(atom, not value)):
            raise InvalidPlan(str(writers[0]), f"{undoing[0]} undoes what it does in the same stage")
    for step in breathing(steps, 64):
        for atom in simulator.reads(step):
            # To write what is so already changes nothing.
            for other in written.get(PlanLiteral(atom, atom not in simulator.state), ()):
                if other != step:
                    raise InvalidPlan(str(step), f"{other} changes {PlanLiteral(atom)} in the same stage")
    return list(written)
