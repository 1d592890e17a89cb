"""The repair engine: an actor that listens to diagnoses, plans, acts, looks whether it has helped, and gives up loudly.

A case goes round: choose a diagnosis, plan for it, carry the plan out, wait until the symptoms are seen to have gone.
If they stay, the next diagnosis is tried. Attempts on each component, rounds and seconds are bounded, so that each case
ends: in `Repaired`, or in `GaveUp` for what is beyond repair.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Final

from ...actors.errors import HoldfastError
from ...actors.events import ActorStarted, ChildRestarted, Event
from ...actors.kernel.actor import Actor, on, subscribe
from ...actors.kernel.cell import RUNNING
from ...actors.kernel.message import Message
from ...supervision.arbiter import SUPERVISOR, Arbiter, Hand, arbiter_of, covers
from ..engine import Diagnosis, State
from ..kept_file import write_kept
from ..literals import BadLiteral, Literal
from ..messages import (
    DIAGNOSER,
    DIAGNOSIS,
    MODEL,
    OBSERVATIONS,
    STARTS,
    TOUCHED,
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
from .advice import Advice, judge_advice
from .approvals import Approvals, Approver
from .case import Case, Watching, base_of, reached
from .choice import CaseView, choose, components_of, problem_for
from .executor import DONE, SKIPPED, UNVERIFIED, Executor, Result
from .harmless import harmless_part
from .ledger import Ledger, Memory
from .outlook import OURS, Outlook
from .ping import answers, looked_at
from .policy import Policy, check_stance
from .story import about, sentence

MOMENT: Final = 0.001
"""Seconds: a timer may come a little early."""


class _Started(Message):
    """Somebody has started a component, a moment ago."""


class _GraceIsOver(Message):
    """After the last action there was time enough to see what is bad."""


class Repairer(Actor):
    """Repairs what `/diagnosis` blames; tells what it does on `/repair`.

    Args:
        model: the components.
        actions: what can be done.
        policy: how far it may go.
        addresses: of components that are actors or subtrees; what has none is not anybody's but ours. It may change.
        base: addresses besides its own without which there is no repair: they and what is above or below them are
            never touched (T64).
        planner: finds plans.
        diagnoser: the address of who is asked for the present diagnosis at the start: diagnoses are published when
            they change, and a life that begins later would not know of one. Unless given, it is looked for beside
            this actor; then all that lives there is part of the base.
        memory: what outlives this actor's lives; see `repairer`.
        approve: is asked for approval besides people; see `Approver`.
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
        approve: Approver | None = None,
    ) -> None:
        self._memory = memory or Memory()
        self._model, self._policy = self._memory.model or model, policy or Policy()
        self._actions = actions if isinstance(actions, Repertoire) else Repertoire(actions)
        self._addresses: Mapping[str, str] = {} if addresses is None else addresses
        self._base = tuple(base)
        self._planner = planner or ClingoPlanner()
        self._diagnoser = diagnoser
        self._ledger = Ledger(self._policy, self._memory)
        self._outlook = Outlook(ObservationSet(self._model.vocabulary))
        self._case: Case | None = None
        self._approvals = Approvals(approve)
        self._wakers: list[asyncio.Future[None]] = []
        self._keeping = asyncio.Lock()
        self._restarted: dict[str, float] = {}

    def on_start(self, restored: bool) -> None:
        """Ask for the present diagnosis."""
        above = self.ctx.path.rpartition("/")[0]
        diagnoser = self._diagnoser or f"{above}/{DIAGNOSER}"
        if self._diagnoser is None and self.ctx._cell.node.find(diagnoser) is not None:
            self._base = (*self._base, above)
        if self.ctx.life == 1:
            self._outlook.looks_until = self.now() + self._policy.look
        self.ctx.create_task(self._listen())
        self.ctx.create_task(self._catch_up(diagnoser))

    async def on_stop(self, reason: object) -> None:
        """Keep scores and denials for the next program."""
        await self._keep()

    async def _keep(self) -> None:
        """Write what the next program is to know, if it has changed; that it cannot be written is told once."""
        memory = self._memory
        async with self._keeping:  # Two threads would write one file.
            kept = memory.to_keep()
            if memory.file is None or kept == memory.kept:
                return
            memory.kept = kept
            try:
                await asyncio.to_thread(write_kept, memory.file, kept)
            except OSError as error:
                text = f"The scores and denials of repair cannot be kept in {memory.file}: {error.strerror or error}."
                self.ctx._cell.node.emit(say.RepairTold(self.ctx.path, 0, "NotKept", text))

    async def _listen(self) -> None:
        """Hear of each start at once, until this life ends: who looks from time to time hears of it too late."""
        events = self.ctx._cell.node.events
        events.add_sink(self._heard)
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            events.remove_sink(self._heard)

    def _heard(self, event: Event) -> None:
        """A life of a component has begun: nobody plans for it before it was seen to work, or not to."""
        if self.ctx._closed:
            return
        if isinstance(event, ChildRestarted):
            self._restarted[event.address.rpartition("/")[0]] = self.now()
        elif isinstance(event, ActorStarted):
            names = tuple(name for name, address in self._addresses.items() if address == event.address)
            # The first life of one who was missed: it was stopped by order, and is there again.
            is_again = event.life > 1 or not set(names).isdisjoint(self._outlook.diagnosis.suspects)
            if names and is_again and self._outlook.note_life(names, self._policy.caution.grace, self.now()):
                if event.life > 1:
                    self._note_others(names, event.address)
                self.ctx.ref.tell(_Started())

    def _note_others(self, names: Iterable[str], address: str) -> None:
        """Somebody else has started components: with a case open it is noted, without one a person had to act."""
        now = self.now()
        self._restarted = {above: when for above, when in self._restarted.items() if now - when < OURS}
        if self._case is not None:
            self._case.others |= dict.fromkeys(names, now)
        elif not any(covers(above, address) for above in self._restarted):
            self._memory.score.missed += 1

    @on(_Started)
    async def _wait_for_grace(self, message: _Started) -> None:
        self.ctx.tell_after(self._policy.caution.grace + MOMENT, _GraceIsOver())
        self._wake()
        await self._keep()

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

    @on(say.SetStance)
    def _set_stance(self, message: say.SetStance) -> None:
        try:
            self._memory.stance = check_stance(message.stance)
        except ValueError as error:
            raise say.BadStance(str(error)) from error
        self._wake()
        self._begin()

    @on(say.RetryRepair)
    async def _retry(self, message: say.RetryRepair) -> None:
        names = message.components or tuple(self._model.components)
        self._ledger.pardon(names)
        for name in names:
            self._memory.given_up.pop(name, None)
        self._begin()
        await self._keep()

    @on(say.Approve)
    def _approved(self, message: say.Approve) -> None:
        self._approvals.answer(message.case, "")

    @on(say.Deny)
    def _denied(self, message: say.Deny) -> None:
        self._approvals.answer(message.case, message.why or "denied")

    @on(say.GetRepairStatus)
    def _status(self, message: say.GetRepairStatus) -> say.RepairStatus:
        memory, wanted = self._memory, self._approvals.wanted
        score = memory.score
        return say.RepairStatus(
            memory.mode,
            self._case is not None,
            tuple(sorted(memory.given_up)),
            memory.cases,
            memory.stance,
            tuple(sorted(memory.denied)),
            0 if wanted is None else wanted.case,
            memory.useless,
            score.right,
            score.wrong,
            score.needless,
            score.missed,
            score.seconds_saved,
            {**memory.given_up, **memory.denied},
        )

    @on(say.GetStories)
    def _stories(self, message: say.GetStories) -> say.CaseStories:
        return say.CaseStories(self._memory.stories.told())

    # -- a case -----------------------------------------------------------------------------------------------------

    def _begin(self) -> None:
        """Open a case, if there is something to repair and none is open."""
        now = self.now()
        if self._memory.stance == "off" or now < self._outlook.looks_until:
            return
        if now < self._outlook.settles(self._model, now):
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
        return None if found is None else found.bad

    def _alone(self) -> set[str]:
        """Whom nobody is to touch."""
        ours = (self.ctx.path, *self._base)
        parked = (name for name, address in self._addresses.items() if self._arbiter.is_parked(address))
        memory = self._memory
        return {*self._policy.exclude, *base_of(self._addresses, ours), *memory.given_up, *memory.denied, *parked}

    def _is_free(self, action: RepairAction, component: str) -> bool:
        """Whether an action reaches nobody whom an operator has stopped or forbidden to touch."""
        address = action.reach(component) if action.reach is not None else None
        if address is None:
            return True
        denied = (self._addresses.get(name, "") for name in self._memory.denied)
        return not any(covers(address, one) for one in denied if one) and not self._arbiter.has_parked(address)

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
            settles=outlook.settles(self._model, now),
            bad=self._chosen(case),
            given_up=self._memory.given_up,
            stance=self._memory.stance,
            is_unsure=is_healthy and deciding.is_unsure(case, self._model, outlook, now),
            stood=outlook.stood(now),
        )

    async def _repair(self, case: Case) -> None:
        try:
            chosen = self._chosen(case) or ()
            case.add_symptoms(self._outlook.diagnosis.symptoms)
            await self._tell(say.RepairBegan(case.number, chosen, case.symptoms))
            decision: deciding.Decision | None = None
            while not isinstance(decision, deciding.Close):
                self._note_vain(case)
                decision = await self._carry_out(
                    case, decision or deciding.decide(case, self._moment(case), self._policy)
                )
            if decision.is_repaired and case.advised and not case.rounds:
                verdict, saved = judge_advice(list(case.advised.values())[-1], case.others)
                self._memory.score.add(verdict, saved)
                await self._tell(say.AdviceScored(case.number, verdict, saved))
            elif decision.is_repaired:
                await self._tell(say.Repaired(case.number, case.helpful(), self.now() - case.began))
        finally:
            self._case = None
        self._begin()

    async def _carry_out(self, case: Case, decision: deciding.Decision) -> deciding.Decision | None:
        """Do what was decided; the next decision, if it follows from that."""
        match decision:
            case deciding.Wait(seconds, wakes):
                await self._sleep(seconds, wakes=wakes)
            case deciding.Enter(phase, held):
                if case.phase is not None and self._outlook.diagnosis.state is State.FAULTY:
                    await self._take_back(case)
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
        if (busy := self._busy(bad)) is not None:
            case.awaited = {name: self._life(name) for name in bad} | case.awaited
            return deciding.Wait(deciding.SOON, wakes=False) if case.has_heard(busy) else deciding.Enter(held=busy)
        awaited = {name: case.awaited.pop(name) for name in sorted(case.awaited.keys() & set(bad))}
        # Of who ended by itself, and hangs in that, its supervisor has begun nothing.
        if back := tuple(name for name, life in awaited.items() if self._life(name) not in (0, life)):
            await self._give_time(back)
            return deciding.Enter()
        problem = problem_for(self._model, self._actions, policy, self._ledger, at, bad, self._alone(), self._is_free)
        outcome = await find_plan(self._planner, problem, timeout=policy.plan_seconds, degrade=True)
        if not isinstance(outcome, Plan) or not outcome.stages:
            return deciding.judge_no_plan(case, bad, outcome, at.mode, policy)
        if self._memory.stance == "on":  # Of what is left the next round plans.
            outcome = harmless_part(problem, outcome, self._is_dangerous, self._address)
        wait = self._ledger.wait(outcome.steps, dict(self._actions.actions), self.now())
        if wait > 0:
            return deciding.Wait(wait)
        if self._outlook.diagnosis is not at.diagnosis and self._chosen(case) != bad:
            return deciding.Enter()  # The world did not wait for the planner.
        if (doubt := await self._doubt(case, bad, outcome)) is not None:
            return doubt
        is_dry = self._memory.stance in ("advise", "off")
        if not (is_dry and bad in case.advised):
            unmet = components_of(outcome.unmet)
            await self._tell(say.Planned(case.number, bad, outcome.stages, unmet, is_dry))
        if is_dry:
            case.advised.setdefault(bad, Advice(self.now(), outcome.steps))
            return deciding.Enter(Watching(bad))
        if (answered := await self._approved_by(case, bad, outcome)) is not None:
            return answered
        case.begin_plan(bad, self._outlook.diagnosis.symptoms)
        results = await self._executor(case).execute(problem, outcome)
        case.failures += [f"{result.step} {result.outcome}: {result.why}" for result in results if result.why]
        case.plan.undos = [(result.step, result.undo) for result in results if result.undo is not None]
        if all(result.outcome in (UNVERIFIED, SKIPPED) for result in results):
            await self._take_back(case)  # Nobody sees its effect: that is no reason to do it again.
        if deciding.was_skipped(results):
            case.take_back_plan(bad)
        return deciding.judge_results(bad, outcome, results, self.now(), policy)

    def _life(self, component: str) -> int:
        """The number of the life of a component that is up; 0 if none is, or if it is still starting."""
        cell = self.ctx._cell.node.find(self._addresses.get(component, ""))
        return cell.life if cell is not None and cell.state is RUNNING and cell.host.is_up(cell) else 0

    async def _give_time(self, names: tuple[str, ...]) -> None:
        """Their supervisor has done its work just now: what was seen while it did says nothing of what has begun."""
        grace = self._policy.caution.grace
        self._outlook.note_start(names, grace, self.now())
        await self.ctx.publish(TOUCHED, say.Touched(names, "restart by its supervisor", self.now(), grace))
        self.ctx.tell_after(grace + MOMENT, _GraceIsOver())

    def _busy(self, bad: tuple[str, ...]) -> str | None:
        """Why those who are blamed are left to their supervisors for now."""
        for name in bad:
            if (address := self._addresses.get(name)) is not None:
                busy = self._arbiter.in_the_way(address, Hand.REPAIR)
                if busy is not None and busy.hand == SUPERVISOR:
                    return f"{busy.address} is left to its supervisor"
        return None

    async def _doubt(self, case: Case, bad: tuple[str, ...], plan: Plan) -> deciding.Decision | None:
        """What to do instead of a plan that restarts who answers; None: the plan stands."""
        steps = [step for step in plan.steps if self._actions[step.action].is_restart and step.args]
        targets = {step.args[0]: address for step in steps if (address := self._addresses.get(step.args[0]))}
        node, seconds = self.ctx._cell.node, self._policy.caution.ping
        said = await asyncio.gather(*(answers(node, address, seconds) for address in targets.values()))
        at = self._moment(case)
        if at.diagnosis.state is State.FAULTY and at.bad != bad:
            return deciding.Enter()  # The world did not wait for the ping.
        pings = dict(zip(targets, said, strict=True))
        return deciding.judge_pings(case, bad, pings, at, self._policy)

    async def _approved_by(self, case: Case, bad: tuple[str, ...], plan: Plan) -> deciding.Decision | None:
        """Have a person approve, if that is needed; what follows if nobody does, None: go on."""
        policy = self._policy
        if self._memory.stance != "ask" and not any(map(self._is_dangerous, plan.steps)):
            return None
        what = ", ".join(map(str, plan.steps))
        diagnosed = f"{', '.join(bad)} {'is' if len(bad) == 1 else 'are'} diagnosed"
        reason = "; ".join((diagnosed, *filter(None, map(self._beyond, plan.steps))))
        wanted = say.ApprovalWanted(case.number, plan.steps, reason, policy.approval)
        why = await self._approvals.ask(wanted, self._tell, self._withdrawn(case, bad))
        if why is None and self._chosen(case) != bad:
            return deciding.Enter()  # Nobody was needed, or others need something first.
        if why is None:
            return deciding.GiveUp(bad, f"nobody has approved {what} within {policy.approval:g} s")
        if why:
            # Who says no to this does not say yes to what would be tried in its place, neither now nor later.
            self._ledger.deny(bad, why)
            return deciding.GiveUp(bad, f"{what} was not allowed: {why}")
        return None

    def _is_dangerous(self, step: Step) -> bool:
        return self._policy.is_dangerous(step.action, self._actions[step.action].is_dangerous)

    async def _withdrawn(self, case: Case, bad: tuple[str, ...]) -> None:
        """Return when another candidate is to be acted on, or the fault has gone, and that has stood for a while."""
        while True:
            left = self._outlook.diagnosed + self._policy.settle - self.now()
            chosen, is_gone = self._chosen(case), self._outlook.diagnosis.state is State.HEALTHY
            is_wanted = chosen == bad or (chosen is None and not is_gone)
            if not is_wanted and left <= 0:
                return
            await self._sleep(math.inf if is_wanted else left, wakes=True)

    def _note_vain(self, case: Case) -> None:
        """What was seen not to help has no credit if the symptoms go by themselves before the plan is judged."""
        again = deciding.seen_again(case, self._outlook, self.now())
        if not again <= case.plan.seen_again:
            case.plan.seen_again |= again
            vain = deciding.vain_in(case, self._model)
            case.note_useless(vain)
            if vain and vain >= case.plan.midway:
                self._memory.useless += case.count_vain()

    async def _take_back(self, case: Case) -> None:
        """If the plan has not helped, count it, and undo of it what can be undone, the newest first."""
        suspects = set(self._outlook.diagnosis.suspects)
        if is_blamed := bool(suspects & case.plan.midway):  # Else it may have helped.
            case.note_useless(self._outlook.diagnosis.certain)
            self._memory.useless += case.count_vain()
        steps = case.take_carried_out()  # Of a plan that was skipped, or judged before, there are none.
        if not steps or not is_blamed:
            return
        node, now = self.ctx._cell.node, self.now()
        for step in steps:
            address = self._addresses.get(step.args[0]) if step.args and step.args[0] in suspects else None
            if address is None or not self._actions[step.action].is_restart:
                continue
            if await answers(node, address, self._policy.caution.ping):
                self._ledger.note_vain(step, now)  # It lives, and is as it was: once more would not be better.
        undos, case.plan.undos = case.plan.undos, []
        for step, undo in reversed(undos):
            try:
                with self._arbiter.held(self._address(step), Hand.REPAIR, f"{step} has not helped"):
                    async with asyncio.timeout(self._actions[step.action].timeout):
                        await undo()
                why = "it has not helped"
            except Exception as error:  # Whatever a user's undo raises is told, and the case goes on.
                why = f"it has not helped, and to undo it has failed ({type(error).__name__}: {error})"
            await self._tell(say.Undone(case.number, step, why))

    def _executor(self, case: Case) -> Executor:
        return Executor(
            self,
            self._arbiter,
            address=self._address,
            actions=self._actions.__getitem__,
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

    def _beyond(self, step: Step) -> str:
        """Who else a step restarts, in words; empty if it touches nobody but its component."""
        at, own = self._address(step), self._addresses.get(step.args[0] if step.args else "")
        is_wide = self._actions[step.action].is_restart and own not in (None, at) and covers(at, own or "")
        return f"{step.action} restarts {at} with all below it" if is_wide else ""

    async def _give_up(self, case: Case, components: Iterable[str], why: str) -> None:
        """Leave components alone from now on, and say so to everybody."""
        names = tuple(name for name in components if name not in self._memory.given_up)
        self._memory.given_up |= dict.fromkeys(names, why)
        suspended = {name: at for name in names if (at := self._addresses.get(name)) and await self._is_suspended(at)}
        symptoms, seconds = self._outlook.diagnosis.symptoms, self.now() - case.began
        plan = tuple(self._for_people(case, [name for name in names if name not in suspended]))
        plan += tuple(f"holdfast resume {address}" for address in suspended.values())
        self.ctx._cell.node.emit(say.RepairGaveUp(self.ctx.path, names, why, plan))
        await self._tell(say.GaveUp(case.number, names, symptoms, why, tuple(case.actions), seconds, plan))

    async def _is_suspended(self, address: str) -> bool:
        """Whether an actor is suspended by order."""
        seen = await looked_at(self.ctx._cell.node, address, self._policy.caution.ping)
        return seen is not None and seen.state == "suspended"

    def _for_people(self, case: Case, names: Iterable[str]) -> Iterator[str]:
        """What a person should try: what repair was not to do or has not tried, and whose word it all rests on."""
        for name in names:
            if name in self._memory.denied:
                yield f"allow {name} to be repaired again, by `holdfast repair retry {name}`"
            for action in self._actions.actions.values():
                step = Step(action.name, (name,))
                if action.is_restart and action.takes(name) and step not in case.actions:
                    beyond = self._beyond(step)
                    yield f"{step}; {beyond}" if beyond else str(step)
        words = {
            word.source: word.literal
            for symptom in case.symptoms
            for word in self._outlook.observations.words(symptom.atom)
            if word.literal == symptom
        }
        yield from (f"look whether {source} is right to say {literal}" for source, literal in words.items())

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
        if result.outcome != SKIPPED:
            others = reached(self._addresses, self._address(step))
            names = tuple(dict.fromkeys((*step.args[:1], *others)))
            grace = self._actions[step.action].grace if result.outcome == DONE else 0.0
            self._outlook.note_touch(names, self.now(), grace)
            if grace > 0:
                self.ctx.tell_after(grace + MOMENT, _GraceIsOver())
            await self.ctx.publish(TOUCHED, say.Touched(names, step.action, self.now(), grace))
        await self._tell(say.ActionEnded(self._case.number, step, result.outcome, result.why, self.now()))

    # -- small things -----------------------------------------------------------------------------------------------

    async def _tell(self, message: say.CaseNotice) -> None:
        if text := sentence(message):
            what, node = type(message).__name__, self.ctx._cell.node
            self._memory.stories.add(message.case, say.StoryEntry(node.clock.wall(), what, text, about(message)))
            node.emit(say.RepairTold(self.ctx.path, message.case, what, text))
        await self.ctx.publish(say.TOPIC, message)
        await self._keep()

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
