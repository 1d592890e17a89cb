"""Parts of a task that are alike but for their names: one of each kind is planned for, and the others do the same.

When a thousand components have failed, most of them have failed in one of a few ways. Parts share no atom, so what is
the best plan for one is the best for all that are like it, and together they are the best plan for the whole.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import TypeAlias

from .grounding import GroundAction
from .language import Atom, Literal
from .relevance import State, Task, Useful, parts

Twins: TypeAlias = Mapping[GroundAction, Sequence[GroundAction]]
"""For an action all that do the same in parts that are alike, itself among them."""


def one_of_each(task: Task) -> tuple[Task, Twins]:
    """The task with one part of each kind."""
    useful = {one.action: one for one in task.useful}
    twins: dict[GroundAction, list[GroundAction]] = {}
    kinds: dict[object, list[GroundAction]] = {}
    goals: list[Literal] = []
    for actions, wanted in parts(task):
        kind = _form([useful[action] for action in actions], wanted, task.init)
        first = kinds.get(kind)
        if first is None:
            kinds[kind] = actions
            goals += wanted
            twins |= {action: [action] for action in actions}
        else:
            for mine, theirs in zip(first, actions, strict=True):
                twins[mine].append(theirs)
    kept = tuple(one for one in task.useful if one.action in twins)
    return dataclasses.replace(task, useful=kept, goals=tuple(goals)), twins


def _form(actions: Iterable[Useful], goals: Iterable[Literal], init: State) -> object:
    """A part with numbers for its atoms: equal only for parts that are alike."""
    numbers: dict[Atom, int] = {}

    def number(literal: Literal) -> tuple[int, bool]:
        return numbers.setdefault(literal.atom, len(numbers)), literal.value

    rows = tuple(
        (
            one.action.cost,
            one.earliest,
            one.after,
            tuple(map(number, sorted(one.action.needs))),
            tuple((tuple(map(number, sorted(made.condition))), number(made.literal)) for made in one.action.effects),
        )
        for one in actions
    )
    wanted = tuple(sorted(map(number, goals)))
    return rows, wanted, tuple(atom in init for atom in numbers)
