"""From a sequence to stages: what may be done at the same time, done as early, or as late, as it can be."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from .grounding import GroundAction
from .language import Atom, Literal


def predecessors(sequence: Sequence[GroundAction]) -> list[set[int]]:
    """For each action, the earlier ones that must stay before it: they touch what it reads, or it what they read.

    Two actions without such a bond can be swapped; so every order that keeps the bonds leads to the same state.
    """
    made: dict[Literal, list[int]] = {}
    needed: dict[Literal, list[int]] = {}
    asked: dict[Atom, list[int]] = {}  # conditions of effects: any change of them matters
    found: list[set[int]] = []
    for index, action in enumerate(sequence):
        before: set[int] = set()
        writes = {effect.literal for effect in action.effects}
        conditions = {literal.atom for effect in action.effects for literal in effect.condition}
        for atom in {literal.atom for literal in action.needs} | conditions:
            before.update(made.get(Literal(atom, True), ()), made.get(Literal(atom, False), ()))
        for atom, value in writes:
            opposite = Literal(atom, not value)
            before.update(made.get(opposite, ()), needed.get(opposite, ()), asked.get(atom, ()))
        found.append(before)
        for literal in action.needs:
            needed.setdefault(literal, []).append(index)
        for atom in conditions:
            asked.setdefault(atom, []).append(index)
        for literal in writes:
            made.setdefault(literal, []).append(index)
    return found


def disturbances(actions: Sequence[GroundAction]) -> set[tuple[int, int]]:
    """Pairs that must not share a stage, because it would matter which comes first; the smaller number first.

    Pairs are left out whose needs contradict each other: they never come together anyway.
    """
    needing: dict[Literal, list[int]] = {}
    making: dict[Literal, list[int]] = {}
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
        opposite = Literal(atom, not value)
        others = {*needing.get(opposite, ()), *making.get(opposite, ()), *asking.get(atom, ())}
        found.update((min(a, b), max(a, b)) for a in makers for b in others if a != b)
    return {(a, b) for a, b in found if not _contradict(actions[a], actions[b])}


def _contradict(a: GroundAction, b: GroundAction) -> bool:
    return any(Literal(atom, not value) in b.needs for atom, value in a.needs)


def stages(sequence: Sequence[GroundAction], late: Collection[str] = ()) -> list[list[GroundAction]]:
    """Stages, as few as the order allows; each action as early as it can be, those named `late` as late as they can.

    The actions of a stage are in the order of their names.
    """
    before = predecessors(sequence)
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
