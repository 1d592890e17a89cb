"""The planner that comes with holdfast: ground actions as an answer set program, solved by clingo.

A plan has as few stages as possible, and among those the least cost. The steps of a stage do not disturb each other, so
they can be done at the same time (the forall-steps of SATPLAN, the mutexes of GraphPlan).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterator, Sequence
from typing import Any, Final

from .alike import OneOfEach
from .answers import Budget, Outcome, OutOfTime, Plan, TimedOut, Unsolvable
from .grounding import GroundAction, Grounder
from .language import Atom, Problem
from .ordering import disturbances, stages
from .relevance import Proof, Task, Useful, hopeless, prove_unsolvable, task_of

PROGRAM: Final = """
{ does(A,First..horizon-After) } :- act(A,_,First,After).
true(F,0) :- init(F).
:- does(A,T), needs(A,F), not true(F,T-1).
:- does(A,T), excludes(A,F), true(F,T-1).
makes(F,T) :- does(A,T), adds(A,F).
ends(F,T) :- does(A,T), deletes(A,F).
fails(A,E,T) :- does(A,T), if(A,E,F), not true(F,T-1).
fails(A,E,T) :- does(A,T), unless(A,E,F), true(F,T-1).
makes(F,T) :- does(A,T), may_add(A,E,F), not fails(A,E,T).
ends(F,T) :- does(A,T), may_delete(A,E,F), not fails(A,E,T).
true(F,T) :- makes(F,T).
true(F,T) :- true(F,T-1), T <= horizon, not ends(F,T).
:- goal(F), not true(F,horizon).
:- avoid(F), true(F,horizon).
:- disturbs(A,B), does(A,T), does(B,T).
#minimize { C,A,T : does(A,T), act(A,C,_,_) }.
#show does/2.
"""

OPTIONS: Final = ("--opt-strategy=usc", "--heuristic=Domain", "--dom-mod=5,16", "--warn=none")
"""Plain branch and bound takes seconds where this takes milliseconds: to do nothing is nearly always right."""
SLICE: Final = 0.05
"""Seconds after which a cancelled budget is noticed."""


class ClingoPlanner:
    """Finds shortest parallel plans. Groundings are kept between calls; it may be used from several threads.

    Args:
        late: actions done in the last stage that allows it: by default starts, so that all hardware is up before the
            first node is started, without a condition that one dead device would make impossible.
        longest: stages a plan may have.
    """

    def __init__(self, *, late: Collection[str] = ("start_node",), longest: int = 200) -> None:
        self._late, self._longest = frozenset(late), longest
        self._grounder = Grounder()

    def solve(self, problem: Problem, budget: Budget) -> Outcome:
        """Solve a problem within a budget, as any `Planner` does."""
        try:
            actions = self._grounder.ground(problem, budget)
            small = OneOfEach(problem, actions)
            task = task_of(problem, small.actions, budget, small.goals)
            if task.hopeless:
                return hopeless(dataclasses.replace(task, hopeless=small.same(task.hopeless)))
            return self._search(task, small, budget)
        except OutOfTime:
            return TimedOut(budget.seconds)

    def _search(self, task: Task, small: OneOfEach, budget: Budget) -> Outcome:
        if not task.least:
            return Plan(())
        for horizon in range(task.least, self._longest + 1):
            budget.check()
            actions = [one for one in task.useful if one.earliest + one.after <= horizon]
            found = _solve("".join(_facts(task, actions)), horizon, budget)
            if found is not None:
                sequence, is_optimal = found
                return self._plan(task, [actions[index].action for index in sequence], small, is_optimal)
            if horizon == task.least:
                # The bound says that so many stages suffice if nothing is in the way: now it is time to doubt.
                proof = prove_unsolvable(task, budget)
                if proof is not None:
                    return _unsolvable(proof, small)
        return TimedOut(budget.seconds, f"there is no plan of up to {self._longest} stages")

    def _plan(self, task: Task, sequence: Sequence[GroundAction], small: OneOfEach, is_optimal: bool) -> Plan:
        made = [[small.twins(action) for action in stage] for stage in stages(sequence, task.init, self._late)]
        steps = tuple(tuple(sorted(twin.step for twins in stage for twin in twins)) for stage in made)
        return Plan(steps, sum(twin.cost for stage in made for twins in stage for twin in twins), is_optimal)


def _unsolvable(proof: Proof, small: OneOfEach) -> Unsolvable:
    if proof.is_each:
        return Unsolvable(small.same(proof.goals), True, "they are met in no state that can be reached")
    return Unsolvable(proof.goals, False, "they are met together in no state that can be reached")


def _facts(task: Task, useful: Sequence[Useful]) -> Iterator[str]:
    """The task as facts of the program, with numbers for actions, effects and atoms."""
    number: dict[Atom, int] = {}

    def of(atom: Atom) -> int:
        return number.setdefault(atom, len(number))

    for index, one in enumerate(useful):
        yield f"act({index},{one.action.cost},{one.earliest},{one.after})."
        for atom, value in one.action.needs:
            yield f"{'needs' if value else 'excludes'}({index},{of(atom)})."
        for place, effect in enumerate(one.action.effects):
            atom, value = effect.literal
            if not effect.condition:
                yield f"{'adds' if value else 'deletes'}({index},{of(atom)})."
                continue
            yield f"{'may_add' if value else 'may_delete'}({index},{place},{of(atom)})."
            for asked, wanted in effect.condition:
                yield f"{'if' if wanted else 'unless'}({index},{place},{of(asked)})."
    for goal in task.goals:
        yield f"{'goal' if goal.value else 'avoid'}({of(goal.atom)})."
    for atom in sorted(task.init & number.keys()):
        yield f"init({number[atom]})."
    for a, b in disturbances([one.action for one in useful]):
        yield f"disturbs({a},{b})."


def _solve(facts: str, horizon: int, budget: Budget) -> tuple[list[int], bool] | None:
    """The actions of the best plan of so many stages, in order, and whether there is surely no better one.

    None: there is no plan of that length. Raises OutOfTime.
    """
    import clingo

    control = clingo.Control(
        [*OPTIONS, "-c", f"horizon={horizon}"], logger=lambda code, text: None
    )  # no words on stderr
    control.add("base", [], PROGRAM + facts)
    control.ground([("base", [])])
    best: list[tuple[int, int]] = []

    def keep(model: Any) -> None:
        best[:] = sorted((does.arguments[1].number, does.arguments[0].number) for does in model.symbols(shown=True))

    is_found = False
    with control.solve(on_model=lambda model: keep(model), async_=True) as handle:
        while not handle.wait(min(SLICE, budget.left)):
            if not budget.left:
                handle.cancel()
                break
        result = handle.get()
        is_found = bool(result.satisfiable)
    if is_found:
        return [action for _, action in best], bool(result.exhausted)
    if result.unsatisfiable:
        return None
    raise OutOfTime
