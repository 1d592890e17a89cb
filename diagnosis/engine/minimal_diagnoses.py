"""The engine: from a model and observations to all minimal diagnoses, within limits of number and time."""

from __future__ import annotations

import asyncio
import contextlib
import math
import threading
import time
from collections import OrderedDict
from collections.abc import Collection, Iterable, Mapping
from typing import Final

import msgspec

from ..literals import Literal
from ..model import Declaration, Model, System
from ..observations import Contradiction, Observed
from .breath import beside_a_loop, breathe, breathing
from .cone import Cone, Index, RulePart, cone_of, contradiction
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
        """As `diagnose_now`, in a thread: the event loop goes on meanwhile. A cancellation stops the search.

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

    def explain(self, observations: Observations) -> Explanation:
        """Why there is something to repair: minimal conflicts, and failures that follow from others."""
        index, observed = self._index, self.observed(observations)
        positive, negative = index.numbers(observed.positive), index.numbers(observed.negative)
        return explain(index, positive, negative)

    def next_observations(
        self,
        observations: Observations,
        diagnosis: Diagnosis,
        *,
        can_be_seen: Iterable[Literal] | None = None,
        costs: Mapping[Literal, float] | None = None,
    ) -> tuple[Probe, ...]:
        """What to look at next to tell the candidates apart, the most telling first; empty if nothing would.

        Args:
            observations: those of the diagnosis.
            diagnosis: the candidates.
            can_be_seen: atoms that could be observed; every atom unless given.
            costs: of observing an atom; 1 unless given. The gain is divided by it.
        """
        index, observed = self._index, self.observed(observations)
        positive, negative = index.numbers(observed.positive), index.numbers(observed.negative)
        seen = index.numbers(tuple(can_be_seen)) if can_be_seen is not None else None
        return probes(index, positive, negative, diagnosis.candidates, seen, costs or {})

    def _beside(self, observations: Observations, repaired: frozenset[str], budget: SearchBudget) -> Diagnosis:
        with beside_a_loop():
            return self._diagnose(observations, repaired, budget)

    def _diagnose(self, observations: Observations, repaired: frozenset[str], budget: SearchBudget) -> Diagnosis:
        began = time.perf_counter()
        with self._lock, contextlib.closing(budget):
            observed = self.observed(observations)
            positive, negative = self._index.numbers(observed.positive), self._index.numbers(observed.negative)
            excluded = self._state_of(observed, positive, negative)
            made = excluded or self._solved(positive, negative, repaired, budget)
            return msgspec.structs.replace(
                made,
                components=self._index.names,
                version=self._model.version,
                seconds=time.perf_counter() - began,
            )

    def _state_of(self, observed: Observed, positive: frozenset[int], negative: frozenset[int]) -> Diagnosis | None:
        """The answer where there can be no diagnosis."""
        if observed.is_blind:
            return Diagnosis(State.BLIND)
        torn = list(observed.contradictions)
        if not torn:
            literals = contradiction(self._index, positive, negative)
            if literals:
                said = [seen for literal in literals for seen in observed.sources.get(literal.atom, ())]
                torn.append(Contradiction(literals, tuple(said), "the model excludes this whatever is faulty"))
        return Diagnosis(State.CONTRADICTORY, contradictions=tuple(torn)) if torn else None

    def _solved(
        self, positive: frozenset[int], negative: frozenset[int], repaired: frozenset[str], budget: SearchBudget
    ) -> Diagnosis:
        cone = cone_of(self._index, positive, negative)
        if not cone.convicted and not cone.parts:
            return Diagnosis(State.HEALTHY, candidates=(Candidate(()),), found=1)
        ranking = Ranking(self._index.components, repaired)
        parts = [solved for part in cone.parts for solved in self._part(part, budget)]
        breathe()
        rows = [self._ranked(solved, ranking) for solved in parts]
        certain = [ranking.set(sorted(cone.faulty))] if cone.faulty else []
        ranked = merged([products([certain, *rows] if certain else rows)], self.limit)
        found = math.prod(part.found for part in parts)
        by_count = found > self.limit or any(part.by_count for part in parts)
        by_time = any(part.by_time for part in parts)
        return Diagnosis(
            State.FAULTY,
            candidates=self._candidates(ranked),
            symptoms=self._symptoms(cone),
            found=found,
            truncated=(*["count"] * by_count, *["time"] * by_time),
        )

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
