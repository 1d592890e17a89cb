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
    ComponentsStarted,
    GetDiagnosis,
    GetObserved,
    ModelChanged,
)
from ..model import Model
from ..observations import Observation, ObservationSet
from ..planning import ClingoPlanner, Plan, Planner, Step, find_plan
from . import case_decisions as deciding
from . import notices as say
from .actions import Act, RepairAction, Repertoire
from .case import Case, base_of, reached
from .choice import CaseView, choose, components_of, problem_for
from .executor import DENIED, DONE, SKIPPED, Executor, Result
from .ledger import Ledger, Memory
from .outlook import Outlook
from .policy import Policy

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
        self._outlook = Outlook(ObservationSet(self._model.vocabulary))
        self._case: Case | None = None
        self._numbers = itertools.count(1)
        self._waiting: dict[int, asyncio.Future[str]] = {}
        self._wakers: list[asyncio.Future[None]] = []
        self._dry: tuple[str, ...] | None = None

    def on_start(self, restored: bool) -> None:
        """Ask for the present diagnosis."""
        above = self.ctx.path.rpartition("/")[0]
        diagnoser = self._diagnoser or f"{above}/{DIAGNOSER}"
        if self._diagnoser is None and self.ctx._cell.node.find(diagnoser) is not None:
            self._base = (*self._base, above)
        if self.ctx.life == 1:
            self._outlook.looks_until = self.now() + self._policy.look
        self.ctx.create_task(self._catch_up(diagnoser))

    async def _catch_up(self, diagnoser: str) -> None:
        """What is known, and what it means; a later life must not plan as if nothing were known."""
        with contextlib.suppress(HoldfastError):  # It publishes its first one when it is there.
            ref = self.ctx.find(diagnoser, Actor)
            known = await ref.ask(GetObserved())
            for word in (word for words in known.sources.values() for word in words):
                self._observe(word)
            found = await ref.ask(GetDiagnosis())
            if self._outlook.diagnosed == -math.inf:
                self._diagnose(found)
        await self._sleep(max(0.0, self._outlook.looks_until - self.now()))
        self._outlook.looks_until = -math.inf
        self._begin()

    # -- what comes in ----------------------------------------------------------------------------------------------

    @subscribe(OBSERVATIONS)
    @on(Observation)
    def _observe(self, message: Observation) -> None:
        with contextlib.suppress(BadLiteral, ValueError):  # The diagnoser tells of what cannot be used.
            self._outlook.observations.add(message)
            self._wake()

    @subscribe(DIAGNOSIS)
    @on(Diagnosis)
    def _diagnose(self, message: Diagnosis) -> None:
        self._outlook.set_diagnosis(message, self.now())
        self._wake()
        self._reconsider(_GraceIsOver())

    @on(_GraceIsOver)
    def _reconsider(self, message: _GraceIsOver) -> None:
        """Who is found good was repaired by somebody; but within a grace period nobody is found bad."""
        for name in self._outlook.found_good(self._memory.given_up, self.now()):
            del self._memory.given_up[name]
        self._begin()

    @on(say.SetMode)
    def _set_mode(self, message: say.SetMode) -> None:
        self._memory.mode = message.mode
        self._wake()
        self._begin()

    @subscribe(STARTS)
    @on(ComponentsStarted)
    def _started(self, message: ComponentsStarted) -> None:
        if self._outlook.note_start(message.components, message.seconds, self.now()):
            self.ctx.tell_after(message.seconds + MOMENT, _GraceIsOver())

    @subscribe(MODEL)
    @on(ModelChanged)
    async def _use_model(self, message: ModelChanged) -> None:
        if message.version <= self._model.version:
            return  # It is said again.
        model = await asyncio.to_thread(Model, message.declaration, message.version)
        self._model = self._memory.model = model
        self._outlook.set_vocabulary(model.vocabulary)

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
        if self.now() < max(self._outlook.looks_until, self._outlook.settles):
            return
        if self._case is None and self._chosen(Case(0, 0.0)) is not None:
            self._memory.cases += 1
            self._case = Case(self._memory.cases, self.now())
            self.ctx.create_task(self._repair(self._case))

    def _chosen(self, case: Case) -> tuple[str, ...] | None:
        found = choose(
            self._outlook.diagnosis,
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

    def _moment(self, case: Case) -> CaseView:
        """What is known now, for the next decision of a case."""
        outlook, now = self._outlook, self.now()
        is_healthy = outlook.diagnosis.state is State.HEALTHY
        return CaseView(
            outlook.diagnosis,
            outlook.observations.current(now),
            self._memory.mode,
            now,
            diagnosed=outlook.diagnosed,
            settles=outlook.settles,
            bad=self._chosen(case),
            given_up=self._memory.given_up,
            was_planned_dry=self._dry is not None,
            is_unsure=is_healthy and deciding.is_unsure(case, self._model, outlook, now),
        )

    async def _repair(self, case: Case) -> None:
        try:
            chosen = self._chosen(case) or ()
            case.add_symptoms(self._outlook.diagnosis.symptoms)
            await self._tell(say.RepairBegan(case.number, chosen, case.symptoms))
            decision: deciding.Decision | None = None
            while not isinstance(decision, deciding.Close):
                decision = await self._carry_out(
                    case, decision or deciding.decide(case, self._moment(case), self._policy)
                )
            if decision.is_repaired:
                await self._tell(say.Repaired(case.number, tuple(case.actions), self.now() - case.began))
        finally:
            self._case = None
        self._begin()

    async def _carry_out(self, case: Case, decision: deciding.Decision) -> deciding.Decision | None:
        """Do what was decided; the next decision, if it follows from that."""
        match decision:
            case deciding.Wait(seconds, wakes):
                await self._sleep(seconds, wakes=wakes)
            case deciding.Enter(phase, held):
                case.enter(phase, self.now())
                if held:
                    await self._tell(say.Held(case.number, held))
            case deciding.PlanFor(bad):
                return await self._plan(case, bad)
            case deciding.Dismiss(bad, why):
                case.hopeless[bad] = why
            case deciding.GiveUp(components, why):
                await self._give_up(case, components, why)
                return deciding.Close(is_repaired=False)
            case deciding.Close():
                return decision
        return None

    async def _plan(self, case: Case, bad: tuple[str, ...]) -> deciding.Decision:
        """Plan for a candidate, and carry the plan out; what follows from that."""
        at, policy = self._moment(case), self._policy
        case.add_symptoms(at.diagnosis.symptoms)
        problem = problem_for(self._model, self._actions, policy, self._ledger, at, bad, self._alone())
        outcome = await find_plan(self._planner, problem, timeout=policy.plan_seconds, degrade=True)
        if not isinstance(outcome, Plan) or not outcome.stages:
            return deciding.judge_no_plan(case, bad, outcome, at.mode, policy)
        wait = self._ledger.wait(outcome.steps, dict(self._actions.actions), self.now())
        if wait > 0:
            return deciding.Wait(wait)
        if self._outlook.diagnosis is not at.diagnosis and self._chosen(case) != bad:
            return deciding.Enter()  # The world did not wait for the planner.
        unmet = components_of(outcome.unmet)
        await self._tell(say.Planned(case.number, bad, outcome.stages, unmet, policy.is_dry))
        if policy.is_dry:
            self._dry = bad
            return deciding.Close(is_repaired=False)
        case.begin_plan(bad)
        results = await self._executor(case).execute(problem, outcome)
        case.failures += [f"{result.step} {result.outcome}: {result.why}" for result in results if result.why]
        if deciding.was_skipped(results):
            case.take_back_plan(bad)
        return deciding.judge_results(bad, outcome, results, self.now(), policy)

    def _executor(self, case: Case) -> Executor:
        return Executor(
            self,
            self._arbiter,
            address=self._address,
            actions=self._actions.__getitem__,
            is_dangerous=lambda one: one.is_dangerous or one.name in self._policy.dangerous,
            make=self._act,
            reason=case.reason,
        )

    def _act(self, step: Step, epoch: int, reason: str, check: Callable[[], None]) -> Act:
        return Act(step, epoch, reason, self.ctx, check)

    @property
    def _arbiter(self) -> Arbiter:
        return arbiter_of(self.ctx._cell.node)

    def _address(self, step: Step) -> str:
        """What a step acts on, for the arbiter."""
        target = step.args[0] if step.args else step.action
        reach = self._actions[step.action].reach
        found = reach(target) if reach is not None else None
        return found or self._addresses.get(target) or f"component {target}"

    async def _give_up(self, case: Case, components: Iterable[str], why: str) -> None:
        """Leave components alone from now on, and say so to everybody."""
        names = tuple(name for name in components if name not in self._memory.given_up)
        self._memory.given_up |= dict.fromkeys(names, why)
        symptoms, seconds = self._outlook.diagnosis.symptoms, self.now() - case.began
        self.ctx._cell.node.emit(say.RepairGaveUp(self.ctx.path, names, why))
        await self._tell(say.GaveUp(case.number, names, symptoms, why, tuple(case.actions), seconds))

    # -- what the executor sees and tells ---------------------------------------------------------------------------

    def now(self) -> float:
        """The time in seconds on the loop clock."""
        return asyncio.get_running_loop().time()

    def seen(self, atom: Literal) -> tuple[bool | None, float]:
        """Whether an atom holds, None if that is not known; and when it was last observed."""
        return self._outlook.seen(atom, self.now())

    async def changed(self) -> None:
        """Return when something is observed, or a diagnosis comes."""
        waker = asyncio.get_running_loop().create_future()
        self._wakers.append(waker)
        try:
            await waker
        finally:
            if waker in self._wakers:
                self._wakers.remove(waker)

    def overtaken(self, step: Step) -> str:
        """Why the step is not to be done any more; empty if it is."""
        assert self._case is not None
        return deciding.why_overtaken(step, self._case, self._outlook, self._policy, self._memory.mode, self.now())

    async def approve(self, step: Step) -> str:
        """Ask a person; why a dangerous step must not be done, empty if it may."""
        number, case = next(self._numbers), self._case
        reason = f"case {case.number}: {', '.join(sorted(case.blamed))}" if case is not None else ""
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
        """Note and tell that a step begins."""
        assert self._case is not None
        self._ledger.note(step, self.now())
        self._case.count(step)
        self._outlook.note_touch(reached(self._addresses, self._address(step)), self.now())
        await self._tell(say.ActionBegan(self._case.number, step, epoch, self._case.reason, self.now()))

    async def ended(self, result: Result) -> None:
        """Note and tell that a step has ended, and how."""
        assert self._case is not None
        step = result.step
        if result.outcome not in (SKIPPED, DENIED):
            others = reached(self._addresses, self._address(step))
            names = tuple(dict.fromkeys((*step.args[:1], *others)))
            grace = self._actions[step.action].grace if result.outcome == DONE else 0.0
            self._outlook.note_touch(names, self.now(), grace)
            if grace > 0:
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
