"""Chooses the next observation: the one that tells the candidates apart best (de Kleer and Williams 1987).

A candidate forbids an atom not to hold if it still concludes it; it forbids an atom to hold if with it the failures
could not be. Else it says nothing, and either outcome is taken to be as likely as the other.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from typing import Final

import msgspec

from ..literals import Literal
from .breath import breathe
from .cone import FALSE, Index, RuleStep
from .result import Candidate

CANDIDATES: Final = 16
"""Candidates that are told apart; later ones hardly matter."""

ATOMS: Final = 200
"""Atoms that are looked into."""


class Probe(msgspec.Struct, frozen=True):
    """An atom worth observing: what it tells in bits (per cost), and who is left suspected after each outcome."""

    atom: Literal
    gain: float
    if_so: tuple[tuple[str, ...], ...]
    """Candidates that remain if the atom holds."""
    if_not: tuple[tuple[str, ...], ...]


def probes(
    index: Index,
    positive: frozenset[int],
    negative: frozenset[int],
    candidates: Sequence[Candidate],
    can_be_seen: frozenset[int] | None,
    costs: Mapping[Literal, float],
    until: float = math.inf,
) -> tuple[Probe, ...]:
    """The probes that tell something, best first; none is looked into after `until`, on the monotonic clock."""
    told = candidates[:CANDIDATES]
    if len(told) < 2:
        return ()
    worlds = [_World(index, positive, negative, frozenset(index.number[name] for name in one.bad)) for one in told]
    found: list[Probe] = []
    for atom in _worth_asking(index, positive, negative, told, can_be_seen):
        if time.monotonic() > until:
            break
        breathe()
        literal = index.atoms[atom]
        assert literal is not None
        may_hold = [world.may_hold(atom) for world in worlds]
        may_fail = [not world.holds(atom) for world in worlds]
        gain = _gain([one.probability for one in told], may_hold, may_fail) / costs.get(literal, 1.0)
        if gain > 1e-9:
            if_so = tuple(one.bad for one, may in zip(told, may_hold, strict=True) if may)
            if_not = tuple(one.bad for one, may in zip(told, may_fail, strict=True) if may)
            found.append(Probe(literal, gain, if_so, if_not))
    return tuple(sorted(found, key=lambda probe: (-round(probe.gain, 9), probe.atom)))


def _worth_asking(
    index: Index,
    positive: frozenset[int],
    negative: frozenset[int],
    candidates: Sequence[Candidate],
    can_be_seen: frozenset[int] | None,
) -> list[int]:
    """Unknown atoms that depend on a suspect, or lie between one and a failure."""
    suspects = {index.number[name] for one in candidates for name in one.bad}
    near = (step.head for step in index.steps if not suspects.isdisjoint(step.needs))
    between = (atom for step in index.steps if not suspects.isdisjoint(step.needs) for atom in step.body)
    known = positive | negative | {FALSE}
    asked = [atom for atom in dict.fromkeys((*near, *between)) if atom not in known]
    return [atom for atom in asked if can_be_seen is None or atom in can_be_seen][:ATOMS]


class _World:
    """What follows if just these components are faulty."""

    def __init__(
        self, index: Index, positive: frozenset[int], negative: frozenset[int], faulty: frozenset[int]
    ) -> None:
        self._index, self._positive, self._negative, self._faulty = index, positive, negative, faulty
        self._known: dict[int, bool] = {}

    def holds(self, atom: int) -> bool:
        """Whether the atom is concluded."""
        return self._holds(atom, self._known, None)

    def may_hold(self, atom: int) -> bool:
        """Whether the atom could hold without a failure being concluded not to be one."""
        if self.holds(atom):
            return True
        known: dict[int, bool] = {}
        affected = self._above(atom)
        return not any(
            failure in affected and self._holds(failure, known, atom) for failure in (*self._negative, FALSE)
        )

    def _above(self, atom: int) -> set[int]:
        """The atoms that rules which apply may conclude with the help of this one."""
        above, todo = {atom}, [atom]
        for needed in todo:  # it grows
            for step in self._index.users[needed]:
                if step.head not in above and self._faulty.isdisjoint(step.needs):
                    above.add(step.head)
                    if step.head not in self._negative:
                        todo.append(step.head)
        return above

    def _holds(self, wanted: int, known: dict[int, bool], supposed: int | None) -> bool:
        """Depth first, without recursion: chains may be thousands long."""
        stack = [wanted]
        while stack:
            atom = stack[-1]
            if atom in known:
                stack.pop()
                continue
            applying = [step for step in self._index.makers[atom] if self._faulty.isdisjoint(step.needs)]
            missing = [needed for step in applying for needed in self._unknown(step, known, supposed)]
            if missing:
                stack += missing
                continue
            known[atom] = any(all(self._is_true(needed, known, supposed) for needed in s.body) for s in applying)
            stack.pop()
        return known[wanted]

    def _unknown(self, step: RuleStep, known: dict[int, bool], supposed: int | None) -> list[int]:
        given = (self._positive, self._negative)
        return [n for n in step.body if n != supposed and n not in known and not any(n in one for one in given)]

    def _is_true(self, atom: int, known: dict[int, bool], supposed: int | None) -> bool:
        return atom == supposed or atom in self._positive or known.get(atom, False)


def _gain(weights: Sequence[float], may_hold: Sequence[bool], may_fail: Sequence[bool]) -> float:
    """Expected loss of entropy, in bits."""
    so = [weight * (0.5 if fail else 1.0) * may for weight, may, fail in zip(weights, may_hold, may_fail, strict=True)]
    not_so = [
        weight * (0.5 if may else 1.0) * fail for weight, may, fail in zip(weights, may_hold, may_fail, strict=True)
    ]
    total = math.fsum((*so, *not_so))
    if not total:
        return 0.0
    after = sum(math.fsum(side) / total * _entropy(side) for side in (so, not_so))
    return _entropy(weights) - after


def _entropy(weights: Sequence[float]) -> float:
    total = math.fsum(weights)
    shares = [weight / total for weight in weights if weight > 0] if total else []
    return -math.fsum(share * math.log2(share) for share in shares)
