"""Parts of a problem that are alike but for their names: one of each kind is planned for, and the others do the same.

When a thousand components have failed, most of them have failed in one of a few ways. Parts share no atom, so what is
the best plan for one is the best for all that are like it, and together they are the best plan for the whole.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import TypeAlias

from ..engine.breath import breathing
from ..engine.connected import connected
from .grounding import GroundAction
from .language import Atom, PlanLiteral, Problem
from .relevance import atoms

Numbered: TypeAlias = tuple[int, bool]
"""A literal, by the number of its atom within a part."""


@dataclasses.dataclass(slots=True)
class ActionGroup:
    """Actions that hang together, in order, and their atoms as they are numbered."""

    actions: Sequence[GroundAction]
    atoms: dict[Atom, int]
    goals: list[PlanLiteral]


class OneOfEach:
    """A problem cut down to one part of each kind.

    Attributes:
        actions: of these parts.
        goals: of these parts, and those that no action can change.
    """

    def __init__(self, problem: Problem, actions: Sequence[GroundAction]) -> None:
        self._problem = problem
        parts = [_numbered(some) for some in connected(actions, atoms)]
        owner = {atom: part for part, _ in parts for atom in part.atoms}
        fixed: list[PlanLiteral] = []
        for goal in problem.goals:
            part = owner.get(goal.atom)
            (fixed if part is None else part.goals).append(goal)
        kinds: dict[object, list[ActionGroup]] = {}
        for part, form in breathing(parts):
            if part.goals:
                state = tuple([atom in problem.init for atom in part.atoms])
                wanted = tuple(sorted([(part.atoms[goal.atom], goal.value) for goal in part.goals]))
                kinds.setdefault((form, state, wanted), []).append(part)
        self._alike = {id(alike[0]): alike for alike in kinds.values()}
        self._owner = owner
        first = {id(action) for alike in kinds.values() for action in alike[0].actions}
        self.actions = tuple(action for action in actions if id(action) in first)
        self.goals = (*fixed, *(goal for alike in kinds.values() for goal in alike[0].goals))

    def twins(self, action: GroundAction) -> list[GroundAction]:
        """All actions that do the same in parts that are alike, the action itself among them."""
        part = self._owner[action.effects[0].literal.atom]
        place = part.actions.index(action)
        return [alike.actions[place] for alike in self._alike[id(part)]]

    def same(self, goals: Iterable[PlanLiteral]) -> tuple[PlanLiteral, ...]:
        """These goals, and those that are the same in parts that are alike; in the problem's order."""
        found: set[PlanLiteral] = set()
        for goal in goals:
            part = self._owner.get(goal.atom)
            if part is None:
                found.add(goal)
                continue
            place = part.atoms[goal.atom]
            found.update(PlanLiteral(list(alike.atoms)[place], goal.value) for alike in self._alike[id(part)])
        return tuple(goal for goal in self._problem.goals if goal in found)


def _numbered(actions: Sequence[GroundAction]) -> tuple[ActionGroup, object]:
    """A part, and its form: equal only for parts that are alike."""
    numbers: dict[Atom, int] = {}

    def number(literal: PlanLiteral) -> Numbered:
        return numbers.setdefault(literal.atom, len(numbers)), literal.value

    form = tuple(
        [
            (
                action.step.action,  # By its name it may be done late.
                action.cost,
                tuple(map(number, sorted(action.needs))),
                tuple([(tuple(map(number, sorted(one.condition))), number(one.literal)) for one in action.effects]),
            )
            for action in actions
        ]
    )
    return ActionGroup(actions, numbers, []), form
