"""Cuts a planning problem down to what can be reached, what matters to the goals, and what hangs together.

Source: the relaxed planning graph of Hoffmann and Nebel 2001 (FF), here with negative literals as facts of their own.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import TypeAlias

from ..engine.connected import connected
from .answers import Budget, OutOfTime, Unsolvable
from .grounding import GroundAction, changing_part, holds
from .language import Atom, PlanLiteral, Problem

State: TypeAlias = frozenset[Atom]

MOST_STATES = 20_000
"""States looked at, for the proof that there is no plan."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Useful:
    """An action that matters.

    Attributes:
        earliest: no plan has it in an earlier stage; the first is 1.
        after: stages that must follow it if it is to be of use.
    """

    action: GroundAction
    earliest: int
    after: int


@dataclasses.dataclass(frozen=True)
class Task:
    """A ground problem, cut down to what matters.

    Attributes:
        useful: the actions that can become possible and can matter.
        hopeless: goals out of reach of any sequence of actions.
        least: stages that any plan has at least.
    """

    useful: tuple[Useful, ...]
    init: State
    goals: tuple[PlanLiteral, ...]
    hopeless: tuple[PlanLiteral, ...]
    least: int


def task_of(
    problem: Problem, actions: Sequence[GroundAction], budget: Budget, goals: Iterable[PlanLiteral] | None = None
) -> Task:
    """The task of a problem, whose ground actions these are; some of its goals only, if given. Raises OutOfTime."""
    changing = problem.domain.changing()
    wanted = problem.goals if goals is None else tuple(goals)
    fixed = [goal for goal in wanted if goal.atom[0] not in changing]
    hopeless = tuple(goal for goal in fixed if (goal.atom in problem.init) is not goal.value)
    movable = tuple(goal for goal in wanted if goal.atom[0] in changing)
    task = cut_down(actions, changing_part(problem.domain, problem.init), movable, budget)
    return dataclasses.replace(task, hopeless=(*hopeless, *task.hopeless))


def hopeless(task: Task) -> Unsolvable:
    """The answer to a task with hopeless goals."""
    return Unsolvable(task.hopeless, True, "no action brings them about, whatever is done before")


def cut_down(actions: Sequence[GroundAction], init: State, goals: tuple[PlanLiteral, ...], budget: Budget) -> Task:
    """Keep the actions that can be reached and that matter. Raises OutOfTime."""
    earliest, levels = _reached(actions, init, budget)

    def level(goal: PlanLiteral) -> int | None:
        return 0 if (goal.atom in init) is goal.value else levels.get(goal)

    hopeless = tuple(goal for goal in goals if level(goal) is None)
    least = max((level(goal) or 0 for goal in goals), default=0)
    relevant = _relevant([action for action in actions if action in earliest], init, goals, budget)
    after = _lags(relevant, goals)
    useful = tuple(Useful(action, earliest[action], after[action]) for action in relevant if action in after)
    return Task(useful, init, goals, hopeless, least)


def _reached(
    actions: Sequence[GroundAction], init: State, budget: Budget
) -> tuple[dict[GroundAction, int], dict[PlanLiteral, int]]:
    """When each action, and each literal, could be had first if nothing were ever undone.

    An action's effects wait at one literal that they lack; when that comes, they look for the next one.
    """
    earliest: dict[GroundAction, int] = {}
    levels: dict[PlanLiteral, int] = {}
    waiting: dict[PlanLiteral, list[tuple[GroundAction, frozenset[PlanLiteral], list[PlanLiteral]]]] = {}
    ready = [
        (action, action.needs | condition, made) for action in actions for condition, made in _by_condition(action)
    ]
    level = 0
    while ready:
        budget.check()
        level += 1
        reached: dict[PlanLiteral, None] = {}
        for entry in ready:
            action, term, made = entry
            for literal in term:
                if (literal[0] in init) is not literal[1] and literal not in levels:
                    waiting.setdefault(literal, []).append(entry)
                    break
            else:
                earliest.setdefault(action, level)
                for literal in made:
                    if (literal[0] in init) is not literal[1] and literal not in levels:
                        reached[literal] = None
        ready = []
        for literal in reached:
            levels[literal] = level
        for literal in reached:
            ready.extend(waiting.pop(literal, ()))
    return earliest, levels


def _by_condition(action: GroundAction) -> Iterable[tuple[frozenset[PlanLiteral], list[PlanLiteral]]]:
    """An action's effects, those of one condition together."""
    made: dict[frozenset[PlanLiteral], list[PlanLiteral]] = {}
    for effect in action.effects:
        made.setdefault(effect.condition, []).append(effect.literal)
    return made.items()


def _lags(actions: Sequence[GroundAction], goals: Iterable[PlanLiteral]) -> dict[GroundAction, int]:
    """How many stages must follow each action at least: whoever makes no goal must be followed by who needs it."""
    makers: dict[PlanLiteral, list[GroundAction]] = {}
    for action in actions:
        for effect in action.effects:
            makers.setdefault(effect.literal, []).append(action)
    lags: dict[GroundAction, int] = {}
    wanted = dict.fromkeys(goals)
    seen = set(wanted)
    lag = 0
    while wanted:
        fresh = [action for literal in wanted for action in makers.get(literal, ()) if action not in lags]
        lags.update((action, lag) for action in fresh)
        wanted = {}
        for action in fresh:
            wanted.update(dict.fromkeys(literal for literal in action.needs if literal not in seen))
            for effect in action.effects:
                for atom, _ in effect.condition:
                    both = (PlanLiteral(atom, True), PlanLiteral(atom, False))
                    wanted.update(dict.fromkeys(literal for literal in both if literal not in seen))
        seen |= wanted.keys()
        lag += 1
    return lags


def _relevant(
    actions: Sequence[GroundAction], init: State, goals: Iterable[PlanLiteral], budget: Budget
) -> tuple[GroundAction, ...]:
    """The actions that bring about what is needed, or bring back what another of them may take away."""
    makers: dict[PlanLiteral, list[GroundAction]] = {}
    for action in actions:
        for effect in action.effects:
            makers.setdefault(effect.literal, []).append(action)
    needed: set[PlanLiteral] = set()
    broken: set[PlanLiteral] = set()
    sought: set[PlanLiteral] = set()
    chosen: set[GroundAction] = set()
    queue: list[PlanLiteral] = []

    def seek(literal: PlanLiteral) -> None:
        """Literals that are needed and not simply there from the beginning to the end."""
        if literal not in needed or literal in sought:
            return
        if (literal.atom in init) is not literal.value or literal in broken:
            sought.add(literal)
            queue.append(literal)

    def need(literal: PlanLiteral) -> None:
        needed.add(literal)
        seek(literal)

    for goal in goals:
        need(goal)
    while queue:
        budget.check()
        for action in makers.get(queue.pop(), ()):
            if action in chosen:
                continue
            chosen.add(action)
            for literal in action.needs:
                need(literal)
            for effect in action.effects:
                for atom, value in effect.condition:
                    # Also the opposite: that an effect fails to come may be what is wanted of it.
                    need(PlanLiteral(atom, value))
                    need(PlanLiteral(atom, not value))
                opposite = PlanLiteral(effect.literal.atom, not effect.literal.value)
                broken.add(opposite)
                seek(opposite)
    return tuple(action for action in actions if action in chosen)


@dataclasses.dataclass(frozen=True)
class Proof:
    """Goals that no sequence of actions reaches: none of them, if `is_each`; else not all of them together."""

    goals: tuple[PlanLiteral, ...]
    is_each: bool


def prove_unsolvable(task: Task, budget: Budget) -> Proof | None:
    """Look at every state that can be reached, in each part that is independent of the others.

    None: a state was found in which the part's goals are met, in every part, or there are too many states to tell.
    """
    for actions, goals in parts(task):
        proof = _prove_part(actions, task.init, goals, budget)
        if proof is not None:
            return proof
    return None


def parts(task: Task) -> list[tuple[Sequence[GroundAction], tuple[PlanLiteral, ...]]]:
    """The actions and goals that share no atom with the others."""
    made = connected([one.action for one in task.useful], atoms)
    owner = {atom: number for number, actions in enumerate(made) for action in actions for atom in atoms(action)}
    goals: dict[int, list[PlanLiteral]] = {}
    for goal in task.goals:
        if goal.atom in owner:
            goals.setdefault(owner[goal.atom], []).append(goal)
    return [(made[number], tuple(wanted)) for number, wanted in goals.items()]


def atoms(action: GroundAction) -> set[Atom]:
    """The atoms that an action reads or writes."""
    found = {literal.atom for literal in action.needs}
    for effect in action.effects:
        found.add(effect.literal.atom)
        found.update(literal.atom for literal in effect.condition)
    return found


def _prove_part(
    actions: Sequence[GroundAction], init: State, goals: tuple[PlanLiteral, ...], budget: Budget
) -> Proof | None:
    mine = frozenset(atom for action in actions for atom in atoms(action)) | {goal.atom for goal in goals}
    start = init & mine
    seen, queue = {start}, [start]
    met: set[PlanLiteral] = set()
    try:
        for state in queue:  # It grows meanwhile.
            budget.check()
            now = [goal for goal in goals if (goal.atom in state) is goal.value]
            if len(now) == len(goals):
                return None
            met.update(now)
            for action in actions:
                if holds(action.needs, state) and (after := action.after(state)) not in seen:
                    seen.add(after)
                    queue.append(after)
            if len(seen) > MOST_STATES:
                return None
    except OutOfTime:
        return None
    never = tuple(goal for goal in goals if goal not in met)
    return Proof(never, True) if never else Proof(goals, False)
