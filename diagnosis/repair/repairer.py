"""The repair engine: an actor that listens to diagnoses, plans, acts, looks whether it has helped, and gives up loudly.

A case goes round: choose a diagnosis, plan for it, carry the plan out, wait until the symptoms are seen to have gone.
If they stay, the next diagnosis is tried. Attempts on each component, rounds and seconds are bounded, so that each case
ends: in `Repaired`, or in `GaveUp` for what is beyond repair.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Final

from ...actors.errors import HoldfastError
from ...actors.kernel.actor import Actor, on, subscribe
from ...actors.kernel.message import Message
from ...supervision.arbiter import Arbiter, arbiter_of
from ..engine import Diagnosis, State
from ..literals import BadLiteral, Literal
from ..messages import (
    DIAGNOSER,
    DIAGNOSIS,
    MODEL,
    OBSERVATIONS,
    STARTS,
    GetDiagnosis,
    GetObserved,
    ModelChanged,
    Started,
)
from ..model import Model
from ..observations import Observation, ObservationSet
from ..planning import ClingoPlanner, Plan, Planner, Step, TimedOut, Unsolvable, find_plan
from . import notices as say
from .actions import Act, RepairAction, Repertoire
from .case import Case, base_of, reached
from .choice import Situation, choose, components_of, problem_for, remaining, symptoms_held
from .executor import DENIED, DONE, SKIPPED, Executor, Result
from .ledger import Ledger, Memory
from .policy import Policy

OURS: Final = 5.0
"""Seconds after an action in which a start that is seen is taken for its work."""
MOMENT: Final = 0.001
"""Seconds: a timer may come a little early."""


class _GraceIsOver(Message):
    """After the last action there was time enough to see what is bad."""


class Repairer(Actor):
    """Repairs what `/diagnosis` blames; tells what it does on `/repair`.

    Args:
        model: the components.
        actions: what can be done.
        policy: how far it may go.
        addresses: of components that are actors or subtrees; what has none is not anybody's but ours.
        base: addresses besides its own without which there is no repair: they and what is above or below them are
            never touched (T64).
        planner: finds plans.
        diagnoser: the address of who is asked for the present diagnosis at the start: diagnoses are published when
            they change, and a life that begins later would not know of one. Unless given, it is looked for beside
            this actor; then all that lives there is part of the base.
        memory: what outlives this actor's lives; see `repairer`.
    """

    deterministic = False

    def __init__(
        self,
        model: Model,
        actions: Repertoire | Iterable[RepairAction],
        policy: Policy | None = None,
        *,
        addresses: Mapping[str, str] | None = None,
        base: Iterable[str] = (),
        planner: Planner | None = None,
        diagnoser: str | None = None,
        memory: Memory | None = None,
    ) -> None:
        self._memory = memory or Memory()
        self._model, self._policy = self._memory.model or model, policy or Policy()
        self._actions = actions if isinstance(actions, Repertoire) else Repertoire(actions)
        self._addresses, self._base = dict(addresses or {}), tuple(base)
        self._planner = planner or ClingoPlanner()
        self._diagnoser = diagnoser
        self._ledger = Ledger(self._policy, self._memory)
        self._observations = ObservationSet(self._model.vocabulary)
        self._diagnosis = Diagnosis(State.BLIND)
        self._diagnosed = -math.inf
        self._case: Case | None = None
        self._numbers = itertools.count(1)
        self._waiting: dict[int, asyncio.Future[str]] = {}
        self._wakers: list[asyncio.Future[None]] = []
        self._blamed: frozenset[str] = frozenset()
        self._midway: set[str] = set()
        self._dry: tuple[str, ...] | None = None
        self._graced = self._looks_until = self._settles = -math.inf
        self._ours: dict[str, float] = {}
        self._theirs: dict[str, float] = {}

    def on_start(self, restored: bool) -> None:
        """Ask for the present diagnosis."""
        above = self.ctx.path.rpartition("/")[0]
        diagnoser = self._diagnoser or f"{above}/{DIAGNOSER}"
        if self._diagnoser is None and self.ctx.cell.node.find(diagnoser) is not None:
            self._base = (*self._base, above)
        self._looks_until = self.now() + self._policy.look if self.ctx.life == 1 else -math.inf
        self.ctx.create_task(self._catch_up(diagnoser))

    async def _catch_up(self, diagnoser: str) -> None:
        """What is known, and what it means; a later life must not plan as if nothing were known."""
        with contextlib.suppress(HoldfastError):  # It publishes its first one when it is there.
            ref = self.ctx.find(diagnoser, Actor)
            known = await ref.ask(GetObserved())
            for word in (word for words in known.sources.values() for word in words):
                self._observe(word)
            found = await ref.ask(GetDiagnosis())
            if self._diagnosed == -math.inf:
                self._diagnose(found)
        await self._sleep(max(0.0, self._looks_until - self.now()))
        self._looks_until = -math.inf
        self._begin()

    # -- what comes in ----------------------------------------------------------------------------------------------

    @subscribe(OBSERVATIONS)
    @on(Observation)
    def _observe(self, message: Observation) -> None:
        with contextlib.suppress(BadLiteral, ValueError):  # The diagnoser tells of what cannot be used.
            self._observations.add(message)
            self._wake()

    @subscribe(DIAGNOSIS)
    @on(Diagnosis)
    def _diagnose(self, message: Diagnosis) -> None:
        self._diagnosis, self._diagnosed = message, self.now()
        self._wake()
        self._reconsider(_GraceIsOver())

    @on(_GraceIsOver)
    def _reconsider(self, message: _GraceIsOver) -> None:
        """Who is found good was repaired by somebody; but within a grace period nobody is found bad."""
        diagnosis, memory = self._diagnosis, self._memory
        if self.now() >= self._graced and diagnosis.is_complete:
            found_bad = set(diagnosis.suspects)
            memory.given_up = {name: why for name, why in memory.given_up.items() if name in found_bad}
        self._begin()

    @on(say.SetMode)
    def _set_mode(self, message: say.SetMode) -> None:
        self._memory.mode = message.mode
        self._wake()
        self._begin()

    @subscribe(STARTS)
    @on(Started)
    def _started(self, message: Started) -> None:
        """Whom somebody else has started is not blamed for what was seen before; what we start, we know of."""
        now = self.now()
        theirs = [name for name in message.components if now - self._ours.get(name, -math.inf) > OURS]
        if theirs:
            self._theirs |= dict.fromkeys(theirs, now + message.seconds)
            self._settles = max(self._settles, now + message.seconds)
            self._graced = max(self._graced, self._settles)
            self.ctx.tell_after(message.seconds + MOMENT, _GraceIsOver())

    @subscribe(MODEL)
    @on(ModelChanged)
    async def _use_model(self, message: ModelChanged) -> None:
        if message.version <= self._model.version:
            return  # It is said again.
        model = await asyncio.to_thread(Model, message.declaration, message.version)
        self._model = self._memory.model = model
        old, self._observations = self._observations, ObservationSet(model.vocabulary)
        for atom in model.vocabulary:
            for word in old.words(atom):
                self._observations.add(word)

    @on(say.RetryRepair)
    def _retry(self, message: say.RetryRepair) -> None:
        names = message.components or tuple(self._model.components)
        self._ledger.pardon(names)
        for name in names:
            self._memory.given_up.pop(name, None)
        self._dry = None
        self._begin()

    @on(say.Approve)
    def _approved(self, message: say.Approve) -> None:
        self._answer(message.number, "")

    @on(say.Deny)
    def _denied(self, message: say.Deny) -> None:
        self._answer(message.number, message.why or "denied")

    def _answer(self, number: int, why_not: str) -> None:
        waiting = self._waiting.pop(number, None)
        if waiting is None or waiting.done():
            raise say.NobodyWaits(number)
        waiting.set_result(why_not)

    @on(say.GetRepairStatus)
    def _status(self, message: say.GetRepairStatus) -> say.RepairStatus:
        given_up = tuple(sorted(self._memory.given_up))
        return say.RepairStatus(self._memory.mode, self._case is not None, given_up, self._memory.cases)

    # -- a case -----------------------------------------------------------------------------------------------------

    def _begin(self) -> None:
        """Open a case, if there is something to repair and none is open."""
        if self.now() < max(self._looks_until, self._settles):
            return
        if self._case is None and self._chosen(Case(0, 0.0)) is not None:
            self._memory.cases += 1
            self._case = Case(self._memory.cases, self.now())
            self.ctx.create_task(self._repair(self._case))

    def _chosen(self, case: Case) -> tuple[str, ...] | None:
        found = choose(
            self._diagnosis,
            alone=self._alone(),
            given_up=self._memory.given_up,
            hopeless=case.hopeless,
            tried=case.tried,
            tries=case.tries,
        )
        return None if found is None or found.bad == self._dry else found.bad

    def _alone(self) -> set[str]:
        """Whom nobody is to touch."""
        ours = (self.ctx.path, *self._base)
        parked = (name for name, address in self._addresses.items() if self._arbiter.is_parked(address))
        return {*self._policy.exclude, *base_of(self._addresses, ours), *self._memory.given_up, *parked}

    async def _repair(self, case: Case) -> None:
        try:
            chosen = self._chosen(case) or ()
            case.add_symptoms(self._diagnosis.symptoms)
            await self._tell(say.RepairBegan(case.number, chosen, case.symptoms))
            while not await self._round(case):
                pass
        finally:
            self._case = None
            self._blamed = frozenset()
        self._begin()

    async def _round(self, case: Case) -> bool:
        """One plan; True when the case is over."""
        if (left := self._settles - self.now()) > 0:
            await self._sleep(left)
            return False
        diagnosis = self._diagnosis
        if diagnosis.state is State.HEALTHY:
            return await self._finish(case)
        if self._why_unknown():
            return await self._unknown(case)
        case.add_symptoms(diagnosis.symptoms)
        bad = self._chosen(case)
        if bad is None:
            return await self._nothing_left(case)
        if case.rounds >= self._policy.rounds or self.now() - case.began > self._policy.seconds:
            limit = f"{case.rounds} plans in {self.now() - case.began:.3g} s have not helped"
            return await self._give_up(case, diagnosis.suspects, limit)
        situation = Situation(diagnosis, self._observations.current(self.now()), self._memory.mode, self.now())
        alone = self._alone()
        problem = problem_for(self._model, self._actions, self._policy, self._ledger, situation, bad, alone)
        outcome = await find_plan(self._planner, problem, timeout=self._policy.plan_seconds, degrade=True)
        if not isinstance(outcome, Plan) or not outcome.stages:
            return await self._no_plan(case, bad, outcome, situation.mode)
        wait = self._ledger.wait(outcome.steps, dict(self._actions.actions), self.now())
        if wait > 0:
            await self._sleep(wait)
            return False
        if self._diagnosis is not diagnosis and self._chosen(case) != bad:
            return False  # The world did not wait for the planner.
        unmet = components_of(outcome.unmet)
        await self._tell(say.Planned(case.number, bad, outcome.stages, unmet, self._policy.is_dry))
        if self._policy.is_dry:
            self._dry = bad
            return True
        case.rounds += 1
        case.tried[bad] = case.tried.get(bad, 0) + 1
        self._blamed, self._midway = frozenset(bad), set()
        results = await self._executor(bad).execute(problem, outcome)
        case.failures += [f"{result.step} {result.outcome}: {result.why}" for result in results if result.why]
        if denied := [result for result in results if result.outcome == DENIED]:
            # Who says no to this does not say yes to what would be tried in its place.
            return await self._give_up(case, bad, f"{denied[0].step} was not allowed: {denied[0].why}")
        if any(result.outcome == DONE for result in results):
            await self._settled(case, {name for step in outcome.steps for name in step.args[:1]})
        elif all(result.outcome == SKIPPED for result in results):
            case.rounds -= 1  # Somebody else is at it, or the world has moved on: nothing was tried.
            case.tried[bad] -= 1
            await self._sleep(max(self._policy.cool_down, 1.0))
        return False

    def _executor(self, bad: Iterable[str]) -> Executor:
        return Executor(
            self,
            self._arbiter,
            address=self._address,
            actions=self._actions.__getitem__,
            is_dangerous=lambda one: one.is_dangerous or one.name in self._policy.dangerous,
            make=self._act,
            reason=f"diagnosed: {', '.join(bad)}",
        )

    def _act(self, step: Step, epoch: int, reason: str, check: Callable[[], None]) -> Act:
        return Act(step, epoch, reason, self.ctx, check)

    @property
    def _arbiter(self) -> Arbiter:
        return arbiter_of(self.ctx.cell.node)

    def _address(self, step: Step) -> str:
        """What a step acts on, for the arbiter."""
        target = step.args[0] if step.args else step.action
        reach = self._actions[step.action].reach
        found = reach(target) if reach is not None else None
        return found or self._addresses.get(target) or f"component {target}"

    # -- how a round can end ----------------------------------------------------------------------------------------

    async def _settled(self, case: Case, touched: set[str]) -> None:
        """Wait until the symptoms have gone; no longer, once a stable diagnosis blames others than we touched."""
        ends = self.now() + self._policy.verify
        began = self.now()
        while (left := ends - self.now()) > 0 and not self._is_healthy(case):
            quiet = max(began, self._diagnosed) + self._policy.settle - self.now()
            bad = self._chosen(case)
            if quiet <= 0 and (bad is None or touched.isdisjoint(bad)):
                return
            await self._sleep(min(left, quiet) if quiet > 0 else left, wakes=True)

    def _is_healthy(self, case: Case) -> bool:
        if self._diagnosis.state is not State.HEALTHY:
            return False
        return not remaining(case.symptoms, self._observations.current(self.now()))

    async def _finish(self, case: Case) -> bool:
        """The diagnosis finds nothing bad: it counts when the symptoms are seen to have gone."""
        ends = self.now() + self._policy.verify
        while self._diagnosis.state is State.HEALTHY:
            left = remaining(case.symptoms, self._observations.current(self.now()))
            if not left and (self.now() >= ends or not self._is_unsure(case)):
                return await self._repaired(case)
            if self.now() >= ends:
                why = f"nothing is blamed any more, but {', '.join(map(str, left))} was not seen to have gone"
                return await self._give_up(case, (), why)
            await self._sleep(ends - self.now(), wakes=True)
        return False

    def _is_unsure(self, case: Case) -> bool:
        """Whether something depends on whom we touched, was known in this case, and is not seen to hold now (T56).

        Within its grace period a topic that is still silent is neither good nor bad: nobody knows yet.
        """
        for atom in self._model.dependents(case.tries):
            value, when = self.seen(atom)
            if when >= case.began and not value:
                return True
        return False

    async def _repaired(self, case: Case) -> bool:
        await self._tell(say.Repaired(case.number, tuple(case.actions), self.now() - case.began))
        return True

    async def _unknown(self, case: Case) -> bool:
        """No repair starts from observations that say nothing or cannot all be true (T49, T50)."""
        why = self._why_unknown()
        await self._tell(say.Held(case.number, why))
        ends = self.now() + self._policy.unknown
        while self._why_unknown():
            if self.now() >= ends:
                return await self._give_up(case, (), f"{why} for {self._policy.unknown:g} s")
            await self._sleep(ends - self.now(), wakes=True)
        return False

    def _why_unknown(self) -> str:
        """Why it is not known what there is to repair; empty if it is."""
        diagnosis = self._diagnosis
        if diagnosis.state in (State.BLIND, State.CONTRADICTORY):
            return f"the observations are {diagnosis.state.value}"
        if diagnosis.state is State.FAULTY and not symptoms_held(
            diagnosis.symptoms, self._observations.current(self.now())
        ):
            return "nobody observes any more what was diagnosed"
        return ""

    async def _nothing_left(self, case: Case) -> bool:
        """No candidate is open: what is left was given up before, cannot be planned for, or is not ours to touch."""
        if case.hopeless:
            suspects = tuple(name for bad in case.hopeless for name in bad if name not in self._memory.given_up)
            return await self._give_up(case, tuple(dict.fromkeys(suspects)), next(iter(case.hopeless.values())))
        if case.has_told or (case.rounds == 0 and self._dry is not None):
            return True
        return await self._repaired(case)

    async def _no_plan(
        self, case: Case, bad: tuple[str, ...], outcome: Plan | Unsolvable | TimedOut, mode: str
    ) -> bool:
        if isinstance(outcome, TimedOut):
            case.hopeless[bad] = f"no plan was found: {outcome.why}"
            return False
        if mode in self._policy.modes:  # That it was planned in: it may be another one by now.
            await self._tell(say.Held(case.number, f"in mode {mode} nothing can be done for {', '.join(bad)}"))
            while self._memory.mode == mode and self._diagnosis.state is State.FAULTY:
                await self._sleep(math.inf, wakes=True)
            case.began = self.now()
            return False
        why = "nothing is left to try" if any(case.tries.get(name) for name in bad) else "there is no way to repair it"
        case.hopeless[bad] = f"{why}; {case.failures[-1]}" if case.failures else why
        return False

    async def _give_up(self, case: Case, components: Iterable[str], why: str) -> bool:
        """Say so to everybody. True: there is nothing else in this case."""
        names = tuple(name for name in components if name not in self._memory.given_up)
        self._memory.given_up |= dict.fromkeys(names, why)
        case.has_told = True
        told = say.GaveUp(
            case.number, names, self._diagnosis.symptoms, why, tuple(case.actions), self.now() - case.began
        )
        self.ctx.cell.node.emit(say.RepairGaveUp(self.ctx.path, names, why))
        await self._tell(told)
        return True

    # -- what the executor sees and tells ---------------------------------------------------------------------------

    def now(self) -> float:
        """See `World`."""
        return asyncio.get_running_loop().time()

    def seen(self, atom: Literal) -> tuple[bool | None, float]:
        """See `World`."""
        words = self._observations.words(atom)
        now = self.now()
        said = {word.literal.positive for word in words if word.is_current(now)}
        return (said.pop() if len(said) == 1 else None), max((word.time for word in words), default=-math.inf)

    async def changed(self) -> None:
        """See `World`."""
        waker = asyncio.get_running_loop().create_future()
        self._wakers.append(waker)
        try:
            await waker
        finally:
            if waker in self._wakers:
                self._wakers.remove(waker)

    def overtaken(self, step: Step) -> str:
        """See `World`. What was begun is not left halfway: a base that was switched off is switched on again."""
        target = step.args[0] if step.args else ""
        if not self._policy.may(step.action, self._memory.mode):
            return f"mode {self._memory.mode} does not allow it"
        if self.now() < self._theirs.get(target, -math.inf):
            return f"somebody else has just started {target}"
        if target in self._midway:
            return ""
        diagnosis = self._diagnosis
        if diagnosis.state is State.CONTRADICTORY:
            return "the observations are contradictory"
        if self.now() < self._graced:
            return ""  # Nobody is blamed for a while: to be found good means nothing then.
        if target in self._blamed and diagnosis.is_complete and target not in diagnosis.suspects:
            return f"a new diagnosis finds {target} good"
        return ""

    async def approve(self, step: Step) -> str:
        """See `World`."""
        number, case = next(self._numbers), self._case
        reason = f"case {case.number}: {', '.join(sorted(self._blamed))}" if case is not None else ""
        answer: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._waiting[number] = answer
        await self._tell(say.ApprovalWanted(number, step, reason, self._policy.approval))
        try:
            async with asyncio.timeout(self._policy.approval):
                why = await answer
        except TimeoutError:
            why = f"nobody has approved within {self._policy.approval:g} s"
        finally:
            self._waiting.pop(number, None)
        if why:
            self._ledger.deny(step)
        return why

    async def began(self, step: Step, epoch: int) -> None:
        """See `World`."""
        assert self._case is not None
        self._ledger.note(step, self.now())
        self._case.count(step)
        self._midway.update(step.args[:1])
        self._ours |= dict.fromkeys(reached(self._addresses, self._address(step)), self.now())
        reason = f"diagnosed: {', '.join(sorted(self._blamed))}"
        await self._tell(say.ActionBegan(self._case.number, step, epoch, reason, self.now()))

    async def ended(self, result: Result) -> None:
        """See `World`."""
        assert self._case is not None
        step = result.step
        if result.outcome not in (SKIPPED, DENIED):
            others = reached(self._addresses, self._address(step))
            names = tuple(dict.fromkeys((*step.args[:1], *others)))
            self._ours |= dict.fromkeys(names, self.now())
            grace = self._actions[step.action].grace if result.outcome == DONE else 0.0
            if grace > 0:
                self._graced = max(self._graced, self.now() + grace)
                self.ctx.tell_after(grace + MOMENT, _GraceIsOver())
            await self._tell(say.Touched(names, step.action, self.now(), grace))
        await self._tell(say.ActionEnded(self._case.number, step, result.outcome, result.why, self.now()))

    # -- small things -----------------------------------------------------------------------------------------------

    async def _tell(self, message: say.Message) -> None:
        await self.ctx.publish(say.TOPIC, message)

    def _wake(self) -> None:
        wakers, self._wakers = self._wakers, []
        for waker in wakers:
            if not waker.done():
                waker.set_result(None)

    async def _sleep(self, seconds: float, *, wakes: bool = False) -> None:
        """Wait so long; with `wakes` no longer than until something comes in."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(None if seconds == math.inf else seconds):
                await (self.changed() if wakes else asyncio.Event().wait())
