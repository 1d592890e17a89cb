"""The diagnoser: the actor that collects observations and says what is wrong, when that changes."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Mapping
from typing import Any, Final

from ..actors.kernel.actor import Actor, on, subscribe
from ..actors.kernel.envelope import ReplyHandle
from ..actors.kernel.message import Message
from .engine import Diagnoser, Diagnosis, State
from .literals import BadLiteral, Literal
from .messages import (
    DIAGNOSIS,
    EXPLANATION,
    GRACE,
    MODEL,
    OBSERVATIONS,
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
    """Tells the diagnoser that its thread has made a diagnosis."""

    diagnosis: Diagnosis
    explained: Explained


class DiagnoserActor(Actor):
    """Diagnoses when something has changed, not all the time (D42), beside the event loop.

    `/diagnosis` is told of each diagnosis that differs from the last one, healthy ones too; `/explanation` why, and
    what to observe next.

    Args:
        quiet: seconds without a change before a diagnosis is made, so that changes that come together are one. While
            there are changes all the time, one is made after four times as long.
        limit: candidates that are listed at most.
        seconds: for one diagnosis.
        recent: seconds for which what was repaired is suspected last among equals.
        trust: how much each source is worth. Of two that contradict each other, the one that is worth less is not
            believed; between equals there is no diagnosis until they agree (T49).
    """

    deterministic = False

    def __init__(
        self,
        *,
        quiet: float = 0.05,
        limit: int = 1000,
        seconds: float = 1.0,
        recent: float = 30.0,
        trust: Mapping[str, float] | None = None,
    ) -> None:
        self._quiet, self._limit, self._seconds, self._recent = quiet, limit, seconds, recent
        self._trust = dict(trust or {})
        self._repaired: dict[str, float] = {}
        self._refused: dict[tuple[str, str], str] = {}
        self._newest: Diagnosis | None = None
        self._explained = Explained("nothing was observed so far")
        self._waiting: list[ReplyHandle[Any]] = []
        self._is_due = self._is_busy = False
        self._changed = self._first = float("-inf")
        self._known: object = None
        self._expiry = float("inf")

    async def on_start(self, restored: bool) -> None:
        """Ask the model server for the model that is in force."""
        path = f"{self.ctx.path.rpartition('/')[0]}/{SERVER}"
        version = await self.ctx.find(path, ModelServer).ask(GetModel())
        self._engine = await asyncio.to_thread(self._engine_for, version.declaration, version.number)
        self._observations = ObservationSet(self._engine.model.vocabulary, self._trust)

    def _engine_for(self, declaration: Declaration, version: int) -> Diagnoser:
        return Diagnoser(Model(declaration, version), limit=self._limit, seconds=self._seconds)

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
        self._due()

    @subscribe(TOUCHED)
    @on(Touched)
    async def _touched(self, message: Touched) -> None:
        until = message.time + self._recent
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

    @on(GetExplanation, readonly=True)
    def _why(self, message: GetExplanation) -> Explained:
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
        if self._observations.expire(now):
            self._due()
        if self._expiry <= now:
            self._expiry = float("inf")
            following = self._observations.next_expiry()
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
        known = (observed.positive, observed.negative, _torn(observed), repaired, self._engine.model.version)
        if known == self._known:
            self._rest()
            return
        self._known, self._is_busy = known, True
        self.ctx.pipe_to_self(self._diagnose(self._engine, observed, repaired), lambda thought: thought)

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

    async def _diagnose(self, engine: Diagnoser, observed: Observed, repaired: frozenset[str]) -> _Thought:
        diagnosis = await engine.diagnose(observed, repaired=repaired)
        return _Thought(diagnosis, await asyncio.to_thread(self._explain, engine, observed, diagnosis))

    def _explain(self, engine: Diagnoser, observed: Observed, diagnosis: Diagnosis) -> Explained:
        """Say why a diagnosis was made; this is run in a thread."""
        refused = tuple(self._refused.values())
        if diagnosis.state is not State.FAULTY:
            text = "\n".join(map(str, diagnosis.contradictions)) or _STATES[diagnosis.state]
            return Explained(text, refused=refused)
        why = engine.explain(observed)
        probes = engine.next_observations(observed, diagnosis)[:SUGGESTED]
        return Explained(
            str(why),
            tuple(map(str, why.conflicts)),
            tuple(map(str, why.consequences)),
            tuple(NextBest(probe.atom, probe.gain) for probe in probes),
            refused,
        )

    @on(_Thought)
    async def _conclude(self, message: _Thought) -> None:
        self._is_busy = False
        if message.diagnosis.version == self._engine.model.version:  # Else the model has changed meanwhile.
            await self._tell(message)
        if self._is_due:
            self.ctx.tell_after(self._quiet, _Think())
        else:
            self._rest()

    async def _tell(self, message: _Thought) -> None:
        before, self._newest = self._newest, message.diagnosis
        self._explained = message.explained
        if before is None or _content(before) != _content(message.diagnosis):
            await self.ctx.publish(DIAGNOSIS, message.diagnosis)
            await self.ctx.publish(ROS_DIAGNOSTICS, RosDiagnostics(message.diagnosis.ros(self.ctx.now())))
        await self.ctx.publish(EXPLANATION, message.explained)

    def _rest(self) -> None:
        """Answer those who waited for the diagnosis of all that is known."""
        waiting, self._waiting = self._waiting, []
        for handle in waiting:
            handle.reply(self._newest or Diagnosis(State.BLIND, components=tuple(self._engine.model.components)))

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
        diagnosis.state,
        diagnosis.components,
        diagnosis.candidates,
        diagnosis.symptoms,
        diagnosis.truncated,
        torn,
        diagnosis.version,
    )


def _names_below(model: Model, components: Iterable[str]) -> tuple[str, ...]:
    """The components, and the arguments of every atom that depends on them."""
    touched = set(components)
    return tuple(sorted(touched.union(*(atom.args for atom in model.dependents(touched)))))
