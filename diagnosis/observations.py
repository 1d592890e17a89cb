"""Observations: literals with a time, a source and a time to live, and the set of those that hold now.

The paper keeps the newest literal of an atom for ever (D28). Here each source replaces only its own word, so that two
sources that differ are seen as a contradiction (T49) instead of taking turns; and a literal that is not renewed within
its time to live is forgotten: unknown is not `not ok` (T50). When nothing is known any more the set is *blind*.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Final

import msgspec

from ..actors.kernel.message import Message
from .literals import TRENDS, Literal, Vocabulary

MOST_LIARS: Final = 3
"""Sources of one dispute that are taken to lie together at most; with more, nobody is set aside."""


class Observation(Message, gc=False):
    """One literal as seen by one source; what observers publish on `/observations`.

    `time` is in seconds on the loop clock (T67); after `time + time_to_live` the literal is unknown again. `since` is
    when that began which shows it, such as a silence; None if that is not known.
    """

    literal: Literal
    time: float
    source: str
    time_to_live: float = 5.0
    since: float | None = None

    def is_current(self, now: float) -> bool:
        """Say whether it still counts at `now`."""
        return now <= self.time + self.time_to_live


class Contradiction(msgspec.Struct, frozen=True, array_like=True):
    """Observations that cannot all be true; without `observations`, literals that were given without their sources."""

    literals: tuple[Literal, ...]
    observations: tuple[Observation, ...] = ()
    why: str = ""

    def __str__(self) -> str:
        said = [f"{seen.source} says {seen.literal} (at {seen.time:g} s)" for seen in self.observations]
        text = ", but ".join(said or map(str, self.literals))
        return f"{text}: {self.why}" if self.why else text


class Observed(msgspec.Struct, frozen=True):
    """What is known at one moment: atoms that hold, atoms that do not; all others are unknown.

    Contradicted atoms are in neither set.
    """

    positive: frozenset[Literal] = frozenset()
    negative: frozenset[Literal] = frozenset()
    contradictions: tuple[Contradiction, ...] = ()
    sources: Mapping[Literal, tuple[Observation, ...]] = {}
    set_aside: tuple[str, ...] = ()
    """Sources that are not believed: what they say is left out."""

    @property
    def is_blind(self) -> bool:
        """Nothing is known: no repair may start from this."""
        return not (self.positive or self.negative or self.contradictions)

    def has_gone(self, symptom: Literal) -> bool:
        """Whether a symptom is seen to have gone; that nobody says anything of it any more is no cure."""
        if (
            symptom.positive
        ):  # A trend gives way to another one: that it is not said any more is all that is to be seen.
            return symptom not in self.positive
        return symptom.atom in self.positive

    @classmethod
    def of(cls, literals: Iterable[Literal]) -> Observed:
        """From bare literals; an atom with both signs is a contradiction."""
        said = tuple(literals)
        positive = {literal for literal in said if literal.positive}
        negative = {literal.atom for literal in said if not literal.positive}
        torn = _exclusive(positive) | {frozenset((atom, ~atom)) for atom in positive & negative}
        contested = {literal.atom for literals in torn for literal in literals}
        contradictions = tuple(Contradiction(tuple(sorted(literals))) for literals in sorted(torn, key=sorted))
        return cls(frozenset(positive - contested), frozenset(negative - contested), contradictions)


class ObservationSet:
    """The observations that count. Not an actor: whoever owns it feeds it and asks it.

    Args:
        vocabulary: the words that may be used; anything else is refused.
        trust: how much a source is worth (1.0 unless given), where one of two has to give way.
    """

    def __init__(self, vocabulary: Vocabulary, trust: Mapping[str, float] | None = None) -> None:
        self.vocabulary = vocabulary
        self.trust = dict(trust or {})
        self._seen: dict[Literal, dict[str, Observation]] = {}

    def add(self, observation: Observation) -> bool:
        """Take one in; True if what is known may have changed by it.

        An observation older than the last word of the same source on the same atom is left out: messages may cross.

        Raises:
            BadLiteral: the model has no such atom.
            ValueError: the time or the time to live is no number to count with.
        """
        literal = self.vocabulary.check(observation.literal)
        _check_times(observation)
        if literal != observation.literal:
            observation = msgspec.structs.replace(observation, literal=literal)
        by_source = self._seen.setdefault(literal.atom, {})
        last = by_source.get(observation.source)
        if last is not None and last.time > observation.time:
            return False
        by_source[observation.source] = observation
        self._displace(observation)
        return last is None or last.literal != literal or not last.is_current(observation.time)

    def forget(self, source: str) -> None:
        """Drop what a source said: it has ended."""
        for atom in tuple(self._seen):
            self._drop(atom, source)

    def words(self, atom: Literal) -> tuple[Observation, ...]:
        """The last word of each source on an atom, also if it has outlived its time to live."""
        return tuple(self._seen.get(atom.atom, {}).values())

    def expire(self, now: float) -> tuple[Observation, ...]:
        """Drop, and return, what has outlived its time to live."""
        dead = [seen for words in self._seen.values() for seen in words.values() if not seen.is_current(now)]
        for seen in dead:
            self._drop(seen.literal.atom, seen.source)
        return tuple(dead)

    def next_expiry(self) -> float | None:
        """When the next literal becomes unknown, if nothing comes before; None if there is none."""
        ends = [seen.time + seen.time_to_live for words in self._seen.values() for seen in words.values()]
        return min(ends, default=None)

    def current(self, now: float) -> Observed:
        """What is known at `now`; a source that alone explains why others are contradicted is set aside."""
        observed = self._without(frozenset(), now)
        liars = liars_in(observed.contradictions) if observed.contradictions else frozenset[str]()
        if not liars:
            return observed
        return msgspec.structs.replace(self._without(liars, now), set_aside=tuple(sorted(liars)))

    def _without(self, liars: Collection[str], now: float) -> Observed:
        sources = {
            atom: tuple(seen for seen in words.values() if seen.is_current(now) and seen.source not in liars)
            for atom, words in self._seen.items()
        }
        sources = {atom: seen for atom, seen in sources.items() if seen}
        said = Observed.of(seen.literal for words in sources.values() for seen in words)
        contradictions = tuple(_with_sources(torn, sources) for torn in said.contradictions)
        return Observed(said.positive, said.negative, contradictions, sources)

    def settle(self, contradiction: Contradiction) -> tuple[Observation, ...]:
        """Drop, and return, the side that is worth less: the lower trust, then the older word (T49).

        Nothing is dropped if its source has spoken again meanwhile. A diagnosis should wait for the next word of either
        source: who was wrong once may be wrong in more.
        """
        sides: dict[Literal, list[Observation]] = {}
        for seen in contradiction.observations:
            sides.setdefault(seen.literal, []).append(seen)
        if len(sides) < 2:
            return ()
        kept = max(sides.values(), key=lambda side: max(map(self._worth, side)))
        losers = [seen for seen in contradiction.observations if seen.literal != kept[0].literal]
        dropped = [seen for seen in losers if self._seen.get(seen.literal.atom, {}).get(seen.source) is seen]
        for seen in dropped:
            self._drop(seen.literal.atom, seen.source)
        return tuple(dropped)

    def _worth(self, seen: Observation) -> tuple[float, float]:
        return self.trust.get(seen.source, 1.0), seen.time

    def _displace(self, observation: Observation) -> None:
        """A trend takes the place of what the same source said of the same value before."""
        literal = observation.literal
        if literal.positive and literal.name in TRENDS:
            for other in TRENDS:
                atom = Literal(other, literal.args)
                last = self._seen.get(atom, {}).get(observation.source)
                if other != literal.name and last is not None and last.literal.positive:
                    self._drop(atom, observation.source)

    def _drop(self, atom: Literal, source: str) -> None:
        words = self._seen.get(atom)
        if words is not None:
            words.pop(source, None)
            if not words:
                del self._seen[atom]


def liars_in(contradictions: Sequence[Contradiction]) -> frozenset[str]:
    """The sources that must be wrong if as few sources as possible are.

    In each contradiction all sources but those of one side are wrong. Between two that only contradict each other
    nothing can be said; one that contradicts two others that do not contradict each other is it.

    >>> said = {name: Observation(Literal("ok", ("x",), name == "liar"), 0.0, name) for name in ("a", "b", "liar")}
    >>> liars_in([Contradiction((), (said["a"], said["b"], said["liar"]))])
    frozenset({'liar'})
    """
    disputes = [sides for torn in contradictions if len(sides := _sides(torn)) > 1]
    found: set[str] = set()
    while disputes:
        group, disputes = [disputes[0]], disputes[1:]
        names = set().union(*group[0])
        while near := [one for one in disputes if not names.isdisjoint(set().union(*one))]:
            group += near
            names = names.union(*itertools.chain.from_iterable(near))
            disputes = [one for one in disputes if one not in near]
        found |= _least(group, sorted(names))
    return frozenset(found)


def _sides(torn: Contradiction) -> list[frozenset[str]]:
    sides: dict[Literal, set[str]] = {}
    for seen in torn.observations:
        sides.setdefault(seen.literal, set()).add(seen.source)
    return [frozenset(side) for side in sides.values()]


def _least(group: list[list[frozenset[str]]], names: list[str]) -> frozenset[str]:
    """Who is in each of the smallest sets that leave one side of each dispute."""
    for size in range(1, min(MOST_LIARS, len(names) - 1) + 1):
        explaining = [
            wrong
            for wrong in map(frozenset, itertools.combinations(names, size))
            if all(sum(not side <= wrong for side in sides) <= 1 for sides in group)
        ]
        if explaining:
            return frozenset.intersection(*explaining)
    return frozenset()


def _check_times(observation: Observation) -> None:
    if not math.isfinite(observation.time) or math.isnan(observation.time_to_live) or observation.time_to_live < 0:
        raise ValueError(
            f"{observation.literal} by {observation.source}: a time is finite, a time to live not negative"
        )


def _exclusive(positive: set[Literal]) -> set[frozenset[Literal]]:
    """Trends of one value that are said at once."""
    trends: dict[tuple[str, ...], set[Literal]] = {}
    for literal in positive:
        if literal.name in TRENDS:
            trends.setdefault(literal.args, set()).add(literal)
    return {frozenset(said) for said in trends.values() if len(said) > 1}


def _with_sources(torn: Contradiction, sources: Mapping[Literal, tuple[Observation, ...]]) -> Contradiction:
    atoms = dict.fromkeys(literal.atom for literal in torn.literals)
    seen = [seen for atom in atoms for seen in sources[atom] if seen.literal in torn.literals]
    return Contradiction(torn.literals, tuple(sorted(seen, key=lambda one: one.time)))
