"""Fast Downward, or another planner of unified-planning, behind our protocol; needs the extra `planners`.

The plans of most are one step after another; they are brought into stages by what the steps read and write. That they
are the shortest is not promised.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from .answers import Budget, Outcome, OutOfTime, Plan, Step, TimedOut, Unsolvable
from .grounding import GroundAction, Grounder, changing_part
from .language import Atom, PlanningError, Problem
from .ordering import stages
from .pddl_writer import Names, write_domain, write_problem
from .relevance import hopeless, task_of


class UnifiedPlanner:
    """Has a planner of unified-planning solve it; nothing of that is imported before the first problem.

    Args:
        engine: its name there.
        late: as in `ClingoPlanner`.
    """

    def __init__(self, engine: str = "fast-downward", *, late: Collection[str] = ("start_node",)) -> None:
        self._engine, self._late = engine, frozenset(late)
        self._grounder = Grounder()

    def solve(self, problem: Problem, budget: Budget) -> Outcome:
        """See `Planner.solve`. Raises PlanningError if the extra is not installed, or has no such planner."""
        names = Names(problem.everything())
        try:
            actions = self._grounder.ground(problem, budget)
            task = task_of(problem, actions, budget)
            if task.hopeless:
                return hopeless(task)  # Unlike the engines we can say which goals it is.
            result = self._solve(write_domain(problem.domain, names), write_problem(problem, names), budget)
            status = result.status.name
            if status == "UNSOLVABLE_PROVEN":
                return Unsolvable(problem.goals, False, f"{self._engine} has proven it")
            if result.plan is None:
                why = "the time was up" if status == "TIMEOUT" else f"{self._engine} ended with {status}"
                return TimedOut(budget.seconds, why)
            steps = [names.step(one.action.name, map(str, one.actual_parameters)) for one in result.plan.actions]
            sequence = _grounded(problem, steps, actions)
        except OutOfTime:
            return TimedOut(budget.seconds)
        init = changing_part(problem.domain, problem.init)
        made = tuple(tuple(action.step for action in stage) for stage in stages(sequence, init, self._late))
        return Plan(made, sum(action.cost for action in sequence), is_optimal=False)

    def _solve(self, domain: str, problem: str, budget: Budget) -> Any:
        try:
            import unified_planning.shortcuts as up  # pyright: ignore[reportMissingImports]
            from unified_planning.exceptions import (  # pyright: ignore[reportMissingImports]
                UPNoRequestedEngineAvailableException,
            )
            from unified_planning.io import PDDLReader  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise PlanningError(self._engine, "install holdfast[planners] to plan with it") from error
        parsed = PDDLReader().parse_problem_string(domain, problem)
        environment = up.get_environment()
        environment.credits_stream = None
        budget.check()
        try:
            with up.OneshotPlanner(name=self._engine) as planner:
                planner.skip_checks = True  # They refuse costs that this planner understands well.
                return planner.solve(parsed, timeout=budget.left)
        except UPNoRequestedEngineAvailableException as error:
            raise PlanningError(self._engine, "install holdfast[planners] to plan with it") from error


def _grounded(problem: Problem, steps: list[Step], actions: tuple[GroundAction, ...]) -> list[GroundAction]:
    """The ground actions of a sequence; of several variants of a step the one that can be done then."""
    variants: dict[Step, list[GroundAction]] = {}
    for action in actions:
        variants.setdefault(action.step, []).append(action)
    state: frozenset[Atom] = changing_part(problem.domain, problem.init)
    made: list[GroundAction] = []
    for step in steps:
        possible = [action for action in variants.get(step, ()) if action.is_applicable(state)]
        if not possible:
            raise PlanningError(str(step), "the planner does it where it cannot be done")
        made.append(possible[0])
        state = possible[0].after(state)
    return made
