"""The diagnoser: the actor that collects observations and says what is wrong, when that changes."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Mapping
from typing import Any, Final, NamedTuple

import msgspec

from ..actors.kernel.actor import Actor, on, subscribe
from ..actors.kernel.envelope import ReplyHandle
from ..actors.kernel.message import Message
from .doubts import Doubts
from .engine import Diagnoser, Diagnosis, State
from .engine.breath import beside_a_loop
from .literals import BadLiteral, Literal
from .messages import (
    DIAGNOSIS,
    EXPLANATION,
    GRACE,
    MODEL,
    OBSERVATIONS,
    OBSERVERS,
    ROS_DIAGNOSTICS,
    STARTS,
    TOUCHED,
    ComponentsStarted,
    Explained,
    GetDiagnosis,
    GetExplanation,
    GetObserved,
    Grace,
    ModelChanged,
    NextBest,
    ObserverCrashed,
    RosDiagnostics,
    Touched,
)
from .model import Declaration, Model
from .model_server import GetModel, ModelServer
from .observations import Observation, ObservationSet, Observed

SERVER: Final = "model"
"""The last part of the model server's address; the rest is that of the diagnoser's supervisor."""
TICK: Final = 0.001
"""Seconds: a literal is unknown after its last moment, not in it."""
FIRST: Final = 0.05
"""Seconds after which the candidates that are known by then are told, before all are."""
MOST_QUIET: Final = 4
"""Times `quiet` that a diagnosis may be put off by further changes."""
REFUSED: Final = 100
"""Observations without words that are remembered."""
SUGGESTED: Final = 5
"""Observations that are suggested at most."""


class _Think(Message):
    """What is observed has changed, a moment ago."""


class _Expire(Message):
    """A literal may have outlived its time to live."""


class _Thought(Message):
    """Tells the diagnoser that its thread has made a diagnosis, of what was observed."""

    diagnosis: Diagnosis
    observed: Observed
    repaired: frozenset[str]
    is_last: bool
    """Nothing more is to be found in the time there is."""


class _Understood(Message):
    """Tells the diagnoser that its thread has explained a diagnosis."""

    explained: Explained


class _Most(NamedTuple):
    """What one diagnosis may take: candidates that are listed, seconds for them, and seconds for the explanation.

    `recent`: seconds for which what was repaired is suspected last.
    """

    candidates: int
    seconds: float
    explaining: float
    recent: float


class DiagnoserActor(Actor):
    """Diagnoses when something has changed, not all the time (D42), beside the event loop.

    `/diagnosis` is told of each diagnosis that differs from the last one, healthy ones too: first of the candidates
    that are known at once, and of all when they are. `/explanation` is told afterwards why, and what to observe next.

    Args:
        quiet: seconds without a change before a diagnosis is made, so that changes that come together are one. While
            there are changes all the time, one is made after four times as long.
        limit: candidates that are listed at most.
        seconds: for one diagnosis.
        explaining: seconds for one explanation.
        recent: seconds for which what was repaired is suspected last among equals.
        trust: how much each source is worth. Of two that contradict each other, the one that is worth less is not
            believed; between equals, what they contradict each other on is unknown until they agree (T49).
    """

    deterministic = False

    def __init__(
        self,
        *,
        quiet: float = 0.02,
        limit: int = 1000,
        seconds: float = 1.0,
        explaining: float = 1.0,
        recent: float = 30.0,
        trust: Mapping[str, float] | None = None,
    ) -> None:
        self._quiet = quiet
        self._most = _Most(limit, seconds, explaining, recent)
        self._trust = dict(trust or {})
        self._repaired: dict[str, float] = {}
        self._refused: dict[tuple[str, str], str] = {}
        self._newest: Diagnosis | None = None
        self._explained = Explained("nothing was observed so far")
        self._waiting: list[ReplyHandle[Any]] = []
        self._curious: list[ReplyHandle[Any]] = []
        self._unexplained: _Thought | None = None
        self._is_explaining = False
        self._is_due = self._is_busy = False
        self._changed = self._first = float("-inf")
        self._known: object = None
        self._expiry = float("inf")
        self._doubts = Doubts()

    async def on_start(self, restored: bool) -> None:
        """Ask the model server for the model that is in force."""
        path = f"{self.ctx.path.rpartition('/')[0]}/{SERVER}"
        version = await self.ctx.find(path, ModelServer).ask(GetModel())
        self._engine = await asyncio.to_thread(self._engine_for, version.declaration, version.number)
        self._observations = ObservationSet(self._engine.model.vocabulary, self._trust)

    def _engine_for(self, declaration: Declaration, version: int) -> Diagnoser:
        return Diagnoser(Model(declaration, version), limit=self._most.candidates, seconds=self._most.seconds)

    # -- what comes in ----------------------------------------------------------------------------------------------

    @subscribe(OBSERVATIONS)
    @on(Observation)
    def _observe(self, message: Observation) -> Any:
        try:
            has_changed = self._observations.add(message)
        except (BadLiteral, ValueError) as error:
            return self._refuse(message, error)
        self._watch(message.time + message.time_to_live)
        if has_changed:
            self._due()
        return None

    @subscribe(MODEL)
    @on(ModelChanged)
    async def _use(self, message: ModelChanged) -> None:
        if message.version <= self._engine.model.version:
            return  # It came while this life began.
        # A new engine: a diagnosis that is under way goes on with the old one.
        self._engine = await asyncio.to_thread(self._engine_for, message.declaration, message.version)
        model = self._engine.model
        old, self._observations = self._observations, ObservationSet(model.vocabulary, self._trust)
        for seen in old.current(self._now).sources.values():
            for observation in seen:
                if observation.literal in model.vocabulary:
                    self._observations.add(observation)
        self._refused.clear()
        self._doubts.keep(model.vocabulary)
        self._due()

    @subscribe(OBSERVERS)
    @on(ObserverCrashed)
    def _observer_crashed(self, message: ObserverCrashed) -> None:
        self._watch(self._doubts.note_crash(message.source, message.why, self._now))
        self._due()

    @subscribe(TOUCHED)
    @on(Touched)
    async def _touched(self, message: Touched) -> None:
        until = message.time + self._most.recent
        self._repaired |= dict.fromkeys(message.components, until)
        if message.grace > 0:
            names = _names_below(self._engine.model, message.components)
            await self.ctx.publish(GRACE, Grace(names, message.grace))
        self._due()

    @subscribe(STARTS)
    @on(ComponentsStarted)
    async def _started(self, message: ComponentsStarted) -> None:
        """Who was started by others is given as much time as who was started by repair."""
        names = _names_below(self._engine.model, message.components)
        await self.ctx.publish(GRACE, Grace(names, message.seconds, is_counted=True))
        self._due()

    @on(GetDiagnosis)
    def _get(self, message: GetDiagnosis) -> Any:
        if self._is_due or self._is_busy:
            handle = self.ctx.reply_handle()
            self._waiting.append(handle)
            return handle
        return self._newest or Diagnosis(State.BLIND, components=tuple(self._engine.model.components))

    @on(GetExplanation)
    def _why(self, message: GetExplanation) -> Any:
        if self._is_due or self._is_busy or self._is_explaining:
            handle = self.ctx.reply_handle()
            self._curious.append(handle)
            return handle
        return self._explained

    @on(GetObserved, readonly=True)
    def _observed(self, message: GetObserved) -> Observed:
        return self._observations.current(self._now)

    # -- when to think ----------------------------------------------------------------------------------------------

    @property
    def _now(self) -> float:
        return self.ctx._cell.node.loop.time()

    def _due(self) -> None:
        self._changed = self._now
        if not self._is_due:
            self._is_due, self._first = True, self._changed
            if not self._is_busy:
                self.ctx.tell_after(self._quiet, _Think())

    def _watch(self, end: float) -> None:
        """See to it that somebody looks when a literal ends; most are renewed before."""
        if end < self._expiry:
            self._expiry = end
            self.ctx.tell_after(max(0.0, end - self._now) + TICK, _Expire())

    @on(_Expire)
    def _expire(self, message: _Expire) -> None:
        now = self._now
        if any((self._observations.expire(now), self._doubts.expire(now))):
            self._due()
        if self._expiry <= now:
            self._expiry = float("inf")
            for following in (self._observations.next_expiry(), self._doubts.next_expiry()):
                if following is not None:
                    self._watch(following)

    @on(_Think)
    def _think(self, message: _Think) -> None:
        now = self._now
        wait = min(self._changed + self._quiet, self._first + MOST_QUIET * self._quiet) - now
        if wait > TICK:
            self.ctx.tell_after(wait, _Think())
            return
        self._is_due = False
        observed = self._believed(now)
        repaired = frozenset(name for name, until in self._repaired.items() if until > now)
        version, crashed = self._engine.model.version, self._doubts.crashed
        known = (observed.positive, observed.negative, _torn(observed), repaired, crashed, version)
        if known == self._known:
            self._rest()
            return
        self._known, self._is_busy = known, True
        self.ctx.pipe_to_self(self._soon(self._engine, observed, repaired), lambda thought: thought)

    def _believed(self, now: float) -> Observed:
        """What is known, where one side of a contradiction is worth less without that side."""
        self._observations.expire(now)
        observed = self._observations.current(now)
        for torn in observed.contradictions:
            worth: dict[Literal, float] = {}
            for seen in torn.observations:
                worth[seen.literal] = max(worth.get(seen.literal, 0.0), self._trust.get(seen.source, 1.0))
            if len(set(worth.values())) > 1:
                self._observations.settle(torn)
        return self._observations.current(now)

    # -- thinking ---------------------------------------------------------------------------------------------------

    async def _soon(self, engine: Diagnoser, observed: Observed, repaired: frozenset[str]) -> _Thought:
        """What is known within the first moments of a search."""
        diagnosis = await engine.diagnose(observed, repaired=repaired, seconds=min(FIRST, self._most.seconds))
        is_last = "time" not in diagnosis.truncated or self._most.seconds <= FIRST
        return _Thought(diagnosis, observed, repaired, is_last)

    async def _rest_of(self, engine: Diagnoser, first: _Thought) -> _Thought:
        """All that is known in the time for a diagnosis; parts that were thought through are remembered."""
        diagnosis = await engine.diagnose(first.observed, repaired=first.repaired)
        return _Thought(diagnosis, first.observed, first.repaired, True)

    async def _understand(self, engine: Diagnoser, thought: _Thought) -> _Understood:
        return _Understood(await asyncio.to_thread(self._explain, engine, thought.observed, thought.diagnosis))

    def _explain(self, engine: Diagnoser, observed: Observed, diagnosis: Diagnosis) -> Explained:
        """Say why a diagnosis was made; this is run in a thread."""
        refused = tuple(self._refused.values())
        aside = [f"{source} contradicts several others, and is not believed" for source in diagnosis.set_aside]
        unseen = [f"nobody says whether {atom} holds" for atom in engine.unseen(observed)]
        crashed = [f"observer {path} has crashed: {why}" for path, why in diagnosis.crashed_observers.items()]
        torn = [*map(str, diagnosis.contradictions), *aside]
        if diagnosis.state is not State.FAULTY:
            text = "\n".join(torn) or _STATES[diagnosis.state]
            if diagnosis.state is State.HEALTHY and diagnosis.unknown:
                text += f"; nothing is seen of the work of {diagnosis.unknown_in_words()}"
            return Explained("\n".join([text, *unseen, *crashed]), refused=refused)
        with beside_a_loop():
            why = engine.explain(observed, seconds=self._most.explaining)
            probes = engine.next_observations(observed, diagnosis, seconds=self._most.explaining)[:SUGGESTED]
        return Explained(
            "\n".join([str(why), *torn, *unseen, *crashed]),
            tuple(map(str, why.conflicts)),
            tuple(map(str, why.consequences)),
            tuple(NextBest(probe.atom, probe.gain) for probe in probes),
            refused,
        )

    @on(_Thought)
    async def _conclude(self, message: _Thought) -> None:
        is_of_now = message.diagnosis.version == self._engine.model.version  # Else the model has changed meanwhile.
        if is_of_now:
            diagnosis = await self._tell(message.diagnosis, message.observed)
            message = msgspec.structs.replace(message, diagnosis=diagnosis)
        if is_of_now and not message.is_last and not self._is_due:
            self.ctx.pipe_to_self(self._rest_of(self._engine, message), lambda thought: thought)
            return
        self._is_busy = False
        if is_of_now:
            self._unexplained = message
            self._begin_to_explain()
        if self._is_due:
            self.ctx.tell_after(self._quiet, _Think())
        else:
            self._rest()

    async def _tell(self, diagnosis: Diagnosis, observed: Observed) -> Diagnosis:
        """Publish it if it says something new; returns it with all that is known besides."""
        uncleared = self._doubts.uncleared(diagnosis, observed)
        if diagnosis.state in (State.HEALTHY, State.FAULTY):
            unknown = tuple(name for name in diagnosis.components if name in {*diagnosis.unknown, *uncleared})
            diagnosis = msgspec.structs.replace(diagnosis, unknown=unknown, uncleared=uncleared)
        diagnosis = msgspec.structs.replace(diagnosis, crashed_observers=dict(self._doubts.crashed))
        before, now = self._newest, self.ctx._cell.node.clock.wall()
        known = {} if before is None else before.since
        since = {name: known.get(name, now) for name in diagnosis.suspects}
        known_until = {} if before is None else _known_until(before, diagnosis, now)
        self._newest = diagnosis = msgspec.structs.replace(diagnosis, since=since, known_until=known_until)
        if before is None or _content(before) != _content(diagnosis):
            await self.ctx.publish(DIAGNOSIS, diagnosis)
            await self.ctx.publish(ROS_DIAGNOSTICS, RosDiagnostics(diagnosis.ros(self.ctx.now())))
        return diagnosis

    def _begin_to_explain(self) -> None:
        """One explanation at a time: of several diagnoses that come meanwhile, the newest is explained."""
        thought = self._unexplained
        if thought is not None and not self._is_explaining:
            self._unexplained, self._is_explaining = None, True
            self.ctx.pipe_to_self(self._understand(self._engine, thought), lambda understood: understood)

    @on(_Understood)
    async def _understood(self, message: _Understood) -> None:
        self._is_explaining = False
        self._explained = message.explained
        await self.ctx.publish(EXPLANATION, message.explained)
        self._begin_to_explain()
        self._rest()

    def _rest(self) -> None:
        """Answer those who waited for the diagnosis of all that is known, or for why."""
        if self._is_due or self._is_busy:
            return
        waiting, self._waiting = self._waiting, []
        for handle in waiting:
            handle.reply(self._newest or Diagnosis(State.BLIND, components=tuple(self._engine.model.components)))
        if not self._is_explaining:
            curious, self._curious = self._curious, []
            for handle in curious:
                handle.reply(self._explained)

    async def _refuse(self, message: Observation, error: Exception) -> None:
        """Say it loudly, but once: a literal that the model does not know must not be lost in silence (T53)."""
        key = (message.source, str(message.literal))
        if key in self._refused or len(self._refused) >= REFUSED:
            return
        self._refused[key] = f"{message.source}: {error}"
        old = self._explained
        self._explained = Explained(
            old.text, old.conflicts, old.consequences, old.next_best, tuple(self._refused.values())
        )
        await self.ctx.publish(EXPLANATION, self._explained)


_STATES: Final = {
    State.HEALTHY: "everything that is observed is as it should be",
    State.BLIND: "nothing is observed: nothing is known",
    State.CONTRADICTORY: "what is observed cannot all be true",
}


def _torn(observed: Observed) -> tuple[tuple[Literal, ...], ...]:
    return tuple(one.literals for one in observed.contradictions)


def _content(diagnosis: Diagnosis) -> object:
    """What a diagnosis says, without when and how fast it was made."""
    torn = tuple(one.literals for one in diagnosis.contradictions)
    return (
        diagnosis.convicted,
        diagnosis.crashed_observers,
        diagnosis.uncleared,
        diagnosis.set_aside,
        diagnosis.state,
        diagnosis.components,
        diagnosis.candidates,
        diagnosis.symptoms,
        diagnosis.truncated,
        torn,
        diagnosis.version,
    )


def _unseen(diagnosis: Diagnosis) -> set[str]:
    return set(diagnosis.components if diagnosis.state is State.BLIND else diagnosis.unknown)


def _known_until(before: Diagnosis, diagnosis: Diagnosis, now: float) -> dict[str, float]:
    """Until when each was known of whom nothing is seen now: until now, if it was known before."""
    lost = _unseen(diagnosis)
    known = dict.fromkeys(set(before.components) - _unseen(before), now)
    return {name: until for name, until in (before.known_until | known).items() if name in lost}


def _names_below(model: Model, components: Iterable[str]) -> tuple[str, ...]:
    """The components, and the arguments of every atom that depends on them."""
    touched = set(components)
    return tuple(sorted(touched.union(*(atom.args for atom in model.dependents(touched)))))
