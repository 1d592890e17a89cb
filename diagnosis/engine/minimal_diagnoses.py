"""The engine: from a model and observations to all minimal diagnoses, within limits of number and time."""

from __future__ import annotations

import asyncio
import contextlib
import math
import threading
import time
from collections import OrderedDict
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Final

import msgspec

from ..literals import Literal
from ..model import Declaration, Model, System
from ..observations import Contradiction, Observed
from .breath import beside_a_loop, breathe, breathing
from .cone import Cone, Index, NumberedExpectation, RulePart, cone_of, contradiction
from .explain import Explanation, explain
from .probe import Probe, probes
from .rank import Ranked, Ranking, merged, products
from .result import Candidate, Diagnosis, State
from .solve import SearchBudget, Solved, solve

PARTS_KEPT: Final = 256
"""Parts whose diagnoses are remembered."""

Observations = Observed | Iterable[Literal | str]


class Diagnoser:
    """Finds all minimal diagnoses. Not an actor, but safe to use from several threads.

    What is costly is remembered: a part of the system that is observed as it was is not solved again.

    Args:
        model: what to diagnose by.
        limit: candidates that are listed at most; of more, the first by rank are listed.
        seconds: time for one diagnosis.

    >>> robot = System()
    >>> robot.hardware("base")
    >>> robot.driver("driver", on=["base"], out=["/odom"])
    >>> [one.bad for one in Diagnoser(robot).diagnose_now(["not on(base)", "not ok(/odom)"]).candidates]
    [('base',)]
    """

    def __init__(self, model: Model | System | Declaration, *, limit: int = 1000, seconds: float = 1.0) -> None:
        if limit < 1 or not seconds > 0:
            raise ValueError(f"limit {limit} and seconds {seconds} must be greater than 0")
        self.limit, self.seconds = limit, seconds
        self._lock = threading.Lock()
        self._parts: OrderedDict[RulePart, list[Solved]] = OrderedDict()
        self._model = model if isinstance(model, Model) else Model(model)
        self._index = Index(self._model)

    @property
    def model(self) -> Model:
        """The model that diagnoses are made by."""
        return self._model

    def use(self, model: Model) -> None:
        """Diagnose by another model, or another version, from now on."""
        with self._lock:
            self._model, self._index = model, Index(model)
            self._parts.clear()

    async def diagnose(
        self, observations: Observations, *, repaired: Collection[str] = (), seconds: float | None = None
    ) -> Diagnosis:
        """Diagnose as `diagnose_now` does, in a thread: the event loop goes on. A cancellation stops the search.

        Raises:
            BadLiteral: an observation has a name that the model does not declare.
        """
        if not isinstance(observations, Observed):
            observations = tuple(observations)  # it may be read only here
        budget = SearchBudget(self.seconds if seconds is None else seconds)
        work = asyncio.ensure_future(asyncio.to_thread(self._beside, observations, frozenset(repaired), budget))
        try:
            return await asyncio.shield(work)
        except asyncio.CancelledError:
            budget.cancel()
            await asyncio.wait([work])  # soon: the search has been interrupted
            raise

    def diagnose_now(
        self, observations: Observations, *, repaired: Collection[str] = (), seconds: float | None = None
    ) -> Diagnosis:
        """All minimal diagnoses within the limits, best first.

        Args:
            observations: what is known, in one of three forms: `ObservationSet.current`, literals, or their texts.
            repaired: components that were just repaired; they are suspected last among equals.
            seconds: time for this one.

        Raises:
            BadLiteral: an observation has a name that the model does not declare.
        """
        budget = SearchBudget(self.seconds if seconds is None else seconds)
        return self._diagnose(observations, frozenset(repaired), budget)

    def observed(self, observations: Observations) -> Observed:
        """Observations of any form as one; texts are looked up in the model's vocabulary.

        Raises:
            BadLiteral: a literal has a name that the model does not declare.
        """
        if not isinstance(observations, Observed):
            words = self._model.vocabulary
            given = (words.parse(one) if isinstance(one, str) else words.check(one) for one in observations)
            return Observed.of(given)
        return observations

    def explain(self, observations: Observations, *, seconds: float = math.inf) -> Explanation:
        """Explain why there is something to repair: minimal conflicts, and failures that follow from others.

        Args:
            observations: those of the diagnosis.
            seconds: after which no more conflicts are looked for; `left_out` then says how many symptoms have none.
        """
        index = self._index
        positive, negative, _ = self._believed(self.observed(observations))
        return explain(index, positive, negative, time.monotonic() + seconds)

    def next_observations(
        self,
        observations: Observations,
        diagnosis: Diagnosis,
        *,
        can_be_seen: Iterable[Literal | str] | None = None,
        costs: Mapping[Literal | str, float] | None = None,
        seconds: float = math.inf,
    ) -> tuple[Probe, ...]:
        """Say what to look at next to tell candidates apart, the most telling first; empty if nothing would.

        Args:
            observations: those of the diagnosis.
            diagnosis: the candidates.
            can_be_seen: atoms that could be observed; every atom unless given.
            costs: of observing an atom; 1 unless given. The gain is divided by it.
            seconds: after which no more atoms are looked into.
        """
        index = self._index
        positive, negative, _ = self._believed(self.observed(observations))
        check = index.model.vocabulary.check
        seen = None if can_be_seen is None else index.numbers([check(atom) for atom in can_be_seen])
        until = time.monotonic() + seconds
        priced = {check(atom): cost for atom, cost in (costs or {}).items()}
        return probes(index, positive, negative, diagnosis.candidates, seen, priced, until)

    def _beside(self, observations: Observations, repaired: frozenset[str], budget: SearchBudget) -> Diagnosis:
        with beside_a_loop():
            return self._diagnose(observations, repaired, budget)

    def _diagnose(self, observations: Observations, repaired: frozenset[str], budget: SearchBudget) -> Diagnosis:
        began = time.perf_counter()
        with self._lock, contextlib.closing(budget):
            observed = self.observed(observations)
            made = Diagnosis(State.BLIND)
            if not observed.is_blind:
                positive, negative, torn = self._believed(observed)
                contested = self._contested(torn)
                made = self._solved(positive, negative, repaired, budget, contested)
                if torn:  # What is contested is unknown; of the rest there is a diagnosis all the same.
                    is_faulty = made.state is State.FAULTY and bool(made.candidates)
                    state = State.FAULTY if is_faulty else State.CONTRADICTORY
                    candidates = made.candidates if is_faulty else ()
                    made = msgspec.structs.replace(made, state=state, candidates=candidates, contradictions=torn)
                made = msgspec.structs.replace(
                    made, unknown=self._unknown(positive, negative), set_aside=observed.set_aside
                )
            return msgspec.structs.replace(
                made,
                components=self._index.names,
                version=self._model.version,
                seconds=time.perf_counter() - began,
            )

    def _believed(self, observed: Observed) -> tuple[frozenset[int], frozenset[int], tuple[Contradiction, ...]]:
        """The atoms that hold and those that do not, without what the model excludes whoever is faulty."""
        positive, negative = self._index.numbers(observed.positive), self._index.numbers(observed.negative)
        torn = list(observed.contradictions)
        while literals := contradiction(self._index, positive, negative):
            said = [seen for literal in literals for seen in observed.sources.get(literal.atom, ())]
            torn.append(Contradiction(literals, tuple(said), "the model excludes this whatever is faulty"))
            contested = self._index.numbers([literal.atom for literal in literals])
            positive, negative = positive - contested, negative - contested
        return positive, negative, tuple(torn)

    def _contested(self, torn: Iterable[Contradiction]) -> frozenset[int]:
        """The components that account for what is contested: to blame or to clear one of them would be a guess."""
        atoms = self._index.numbers([literal.atom for one in torn for literal in one.literals])
        return frozenset(one for atom in atoms for step in self._index.makers[atom] for one in step.needs)

    def unseen(self, observations: Observations) -> tuple[Literal, ...]:
        """Return the expected atoms of which nobody says whether they hold, though what they are made from does."""
        positive, negative, _ = self._believed(self.observed(observations))
        atoms = (self._index.atoms[one.atom] for one in self._unseen(positive, negative))
        return tuple(dict.fromkeys(atom for atom in atoms if atom is not None))

    def _unseen(self, positive: frozenset[int], negative: frozenset[int]) -> Iterator[NumberedExpectation]:
        known = positive | negative
        return (one for one in self._index.expectations if one.atom not in known and negative.isdisjoint(one.given))

    def _unknown(self, positive: frozenset[int], negative: frozenset[int]) -> tuple[str, ...]:
        """The components of whose work nothing is seen; that one runs says nothing of its work, if it has any.

        Whoever is to make something hold of which nobody says whether it does is unknown, too.
        """
        index, seen = self._index, set[int]()
        for atom in positive:
            is_work = index.is_work(atom)
            for step in index.makers[atom]:
                seen.update(one for one in step.needs if is_work or one in index.only_run)
        seen.difference_update(*(one.needs for one in self._unseen(positive, negative)))
        return tuple(name for number, name in enumerate(index.names) if number not in seen)

    def _solved(
        self,
        positive: frozenset[int],
        negative: frozenset[int],
        repaired: frozenset[str],
        budget: SearchBudget,
        contested: frozenset[int],
    ) -> Diagnosis:
        cone = cone_of(self._index, positive, negative)
        if not cone.convicted and not cone.parts:
            return Diagnosis(State.HEALTHY, candidates=(Candidate(()),), found=1)
        clear = [part for part in cone.parts if contested.isdisjoint(part.components)]
        ranking = Ranking(self._index.components, repaired)
        # The smallest first: what is certain is mostly there, and a large part may take all the time there is.
        order = sorted(clear, key=lambda part: len(part.denials) + len(part.steps))
        every = [solved for part in order for solved in self._part(part, budget)]
        parts = [solved for solved in every if solved.sets]  # Others have run out of time: candidates lack them.
        breathe()
        rows = [self._ranked(solved, ranking) for solved in parts]
        certain = [ranking.set(sorted(cone.faulty))] if cone.faulty else []
        choices = [certain, *rows] if certain else rows
        ranked = merged([products(choices)], self.limit) if choices else []
        found = math.prod(part.found for part in parts) if choices else 0
        by_count = found > self.limit or any(part.by_count for part in parts)
        by_time = any(part.by_time for part in every)
        return Diagnosis(
            State.FAULTY,
            candidates=self._candidates(ranked),
            symptoms=self._symptoms(cone),
            convicted=self._convicted(cone, parts),
            found=found,
            truncated=(*["count"] * by_count, *["time"] * by_time, *["contested"] * (len(clear) < len(cone.parts))),
        )

    def _convicted(self, cone: Cone, parts: list[Solved]) -> tuple[str, ...]:
        """Who is in each diagnosis, also in those that are not listed."""
        sure = set(cone.faulty)
        for part in parts:
            if not (part.by_count or part.by_time):
                shared = set.intersection(*map(set, part.sets))
                sure.update(one for one in shared if len(part.classes[one]) == 1)
        return tuple(self._index.names[one] for one in sorted(sure))

    def _ranked(self, solved: Solved, ranking: Ranking) -> list[Ranked]:
        """The best sets of a part, with classes written out."""
        singles = {first: ranking.singles(members) for first, members in solved.classes.items()}
        rows = (products([singles[member] for member in members]) for members in solved.sets)
        return merged(rows, self.limit)

    def _part(self, part: RulePart, budget: SearchBudget) -> list[Solved]:
        known = self._parts.get(part)
        if known is not None:
            self._parts.move_to_end(part)
            return known
        solved = solve(part, self.limit, budget)
        if not any(one.by_count or one.by_time for one in solved):
            self._parts[part] = solved
            if len(self._parts) > PARTS_KEPT:
                self._parts.popitem(last=False)
        return solved

    def _candidates(self, ranked: list[Ranked]) -> tuple[Candidate, ...]:
        names = self._index.names
        if not ranked:
            return ()
        # Relative to the likeliest, or the exponentials of many faults would all be 0.
        least = min(key.unlikeliness for key, _ in ranked)
        weights = [math.exp(least - key.unlikeliness) for key, _ in ranked]
        total = math.fsum(weights)
        return tuple(
            Candidate(tuple(names[member] for member in sorted(members)), weight / total)
            for (_, members), weight in breathing(zip(ranked, weights, strict=True), 128)
        )

    def _symptoms(self, cone: Cone) -> tuple[Literal, ...]:
        heads = {step.head for step in cone.convicted} | {step.head for part in cone.parts for step in part.denials}
        literals = (self._index.atoms[head] for head in sorted(heads))
        return tuple(~literal for literal in literals if literal is not None)
