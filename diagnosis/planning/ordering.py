"""Turns a sequence of actions into stages that may be done at the same time."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

from .grounding import GroundAction, holds
from .language import Atom, PlanLiteral


def predecessors(sequence: Sequence[GroundAction], init: Iterable[Atom]) -> list[set[int]]:
    """For each action, the earlier ones that must stay before it: they touch what it reads, or it what they read.

    Two actions without such a bond can be swapped; so every order that keeps the bonds leads to the same state. Who
    makes so what is so already has touched nothing, as long as nobody undoes it before.
    """
    state = set(init)
    made: dict[PlanLiteral, list[int]] = {}
    touched: dict[PlanLiteral, list[int]] = {}
    needed: dict[PlanLiteral, list[int]] = {}
    asked: dict[Atom, list[int]] = {}  # conditions of effects: any change of them matters
    found: list[set[int]] = []
    for index, action in enumerate(sequence):
        before: set[int] = set()
        writes = {effect.literal for effect in action.effects}
        conditions = {literal.atom for effect in action.effects for literal in effect.condition}
        for atom in {literal.atom for literal in action.needs} | conditions:
            before.update(touched.get(PlanLiteral(atom, True), ()), touched.get(PlanLiteral(atom, False), ()))
        for atom, value in writes:
            opposite = PlanLiteral(atom, not value)
            before.update(made.get(opposite, ()), needed.get(opposite, ()), asked.get(atom, ()))
        found.append(before)
        for literal in action.needs:
            needed.setdefault(literal, []).append(index)
        for atom in conditions:
            asked.setdefault(atom, []).append(index)
        for literal in writes:
            made.setdefault(literal, []).append(index)
            if (literal.atom in state) is not literal.value:
                touched.setdefault(literal, []).append(index)
        fired = [effect.literal for effect in action.effects if holds(effect.condition, state)]
        state.difference_update([atom for atom, value in fired if not value])
        state.update([atom for atom, value in fired if value])
    return found


def disturbances(actions: Sequence[GroundAction]) -> set[tuple[int, int]]:
    """Pairs that must not share a stage, because it would matter which comes first; the smaller number first.

    Pairs are left out whose needs contradict each other: they never come together anyway.
    """
    needing: dict[PlanLiteral, list[int]] = {}
    making: dict[PlanLiteral, list[int]] = {}
    asking: dict[Atom, list[int]] = {}
    for index, action in enumerate(actions):
        for literal in action.needs:
            needing.setdefault(literal, []).append(index)
        for effect in action.effects:
            making.setdefault(effect.literal, []).append(index)
            for literal in effect.condition:
                asking.setdefault(literal.atom, []).append(index)
    found: set[tuple[int, int]] = set()
    for (atom, value), makers in making.items():
        opposite = PlanLiteral(atom, not value)
        others = {*needing.get(opposite, ()), *making.get(opposite, ()), *asking.get(atom, ())}
        found.update((min(a, b), max(a, b)) for a in makers for b in others if a != b)
    return {(a, b) for a, b in found if not _contradict(actions[a], actions[b])}


def _contradict(a: GroundAction, b: GroundAction) -> bool:
    return any(PlanLiteral(atom, not value) in b.needs for atom, value in a.needs)


def stages(
    sequence: Sequence[GroundAction], init: Iterable[Atom], late: Collection[str] = ()
) -> list[list[GroundAction]]:
    """Stages, as few as the order allows; each action as early as it can be, those named `late` as late as they can.

    The actions of a stage are in the order of their names. `init` is the state in which the sequence begins.
    """
    before = predecessors(sequence, init)
    level: list[int] = []
    for earlier in before:
        level.append(1 + max((level[index] for index in earlier), default=-1))
    last = max(level, default=-1)
    limit = [last] * len(sequence)
    for index in reversed(range(len(sequence))):
        if sequence[index].step.action in late:
            level[index] = limit[index]
        for one in before[index]:
            limit[one] = min(limit[one], level[index] - 1)
    made: list[list[GroundAction]] = [[] for _ in range(last + 1)]
    for index, action in enumerate(sequence):
        made[level[index]].append(action)
    return [sorted(stage, key=lambda action: action.step) for stage in made]
