"""A case of repair against a naive model, which remembers all that was seen, decided and done."""

import math

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from holdfast.diagnosis.engine import Candidate, Diagnosis, State
from holdfast.diagnosis.literals import Literal, ok
from holdfast.diagnosis.observations import Observed
from holdfast.diagnosis.planning import Plan, Step, TimedOut, Unsolvable
from holdfast.diagnosis.repair import DONE, FAILED, NORMAL, SAFE, SKIPPED, Policy
from holdfast.diagnosis.repair.case import Case
from holdfast.diagnosis.repair.case_decisions import (
    Close,
    Decision,
    Dismiss,
    Enter,
    GiveUp,
    PlanFor,
    Wait,
    decide,
    judge_no_plan,
    judge_results,
    was_skipped,
)
from holdfast.diagnosis.repair.choice import CaseView, choose
from holdfast.diagnosis.repair.executor import Result

PARTS = ("a", "b", "c")
POLICY = Policy(rounds=4, seconds=60.0, verify=5.0, settle=1.0, unknown=8.0, modes={SAFE: ()})
MOST_DECISIONS = 200


def topic(name: str) -> Literal:
    """What is published while a component works."""
    return ok(f"/{name}")


class Repair(RuleBasedStateMachine):
    """Components break and heal by themselves; the rest is decided."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0
        self.broken: set[str] = set()
        self.state: State | None = None  # what the diagnosis says, whatever is so; None: the truth
        self.is_seen = True
        self.diagnosed = self.settles = -math.inf
        self.mode = NORMAL
        self.given_up: set[str] = set()
        self.case: Case | None = None
        self.next: Decision | None = None
        self.symptoms: set[Literal] = set()  # the model's
        self.plans: list[tuple[str, ...]] = []
        self.dismissed: set[tuple[str, ...]] = set()
        self.since = 0.0  # when the time of the case began to count

    # -- what is so, and what is known of it --------------------------------------------------------------------------

    @property
    def diagnosis(self) -> Diagnosis:
        state = self.state or (State.FAULTY if self.broken else State.HEALTHY)
        if state is not State.FAULTY or not self.broken:
            return Diagnosis(state if state is not State.FAULTY else State.HEALTHY, PARTS)
        both = Candidate(tuple(sorted(self.broken)))
        singles = [Candidate((name,)) for name in sorted(self.broken)] if len(self.broken) > 1 else []
        return Diagnosis(state, PARTS, (both, *singles), tuple(~topic(name) for name in sorted(self.broken)))

    @property
    def observed(self) -> Observed:
        if not self.is_seen:
            return Observed()
        return Observed.of([~topic(name) if name in self.broken else topic(name) for name in PARTS])

    def chosen(self, case: Case) -> tuple[str, ...] | None:
        found = choose(
            self.diagnosis,
            alone=self.given_up,
            given_up=self.given_up,
            hopeless=case.hopeless,
            tried=case.tried,
            tries=case.tries,
        )
        return None if found is None else found.bad

    def moment(self, case: Case) -> CaseView:
        return CaseView(
            self.diagnosis,
            self.observed,
            self.mode,
            self.now,
            diagnosed=self.diagnosed,
            settles=self.settles,
            bad=self.chosen(case),
            given_up=self.given_up,
        )

    @rule(
        event=st.sampled_from(("break", "heal", "heal unseen", "misjudge", "see all", "mode", "start")),
        name=st.sampled_from(PARTS),
        state=st.sampled_from((State.BLIND, State.CONTRADICTORY)),
    )
    def change_the_world(self, event: str, name: str, state: State) -> None:
        if event in ("break", "heal", "heal unseen", "misjudge", "see all"):
            self.diagnosed = self.now
        match event:
            case "break":
                self.broken.add(name)
            case "heal":
                self.broken.discard(name)
            case "heal unseen":
                self.broken, self.is_seen = set(), False
            case "misjudge":
                self.state = state
            case "see all":
                self.state, self.is_seen = None, True
            case "mode":
                self.mode = NORMAL if self.mode == SAFE else SAFE
            case _:
                self.settles = max(self.settles, self.now + 3.0)

    # -- a case -------------------------------------------------------------------------------------------------------

    @precondition(lambda self: self.case is None)
    @rule(names=st.sets(st.sampled_from(PARTS), min_size=1))
    def begin(self, names: set[str]) -> None:
        self.state, self.is_seen, self.mode = None, True, NORMAL
        self.broken |= names
        self.given_up -= names
        if self.chosen(Case(0, 0.0)) is not None:
            self.case, self.next = Case(1, self.now), None
            self.symptoms, self.plans, self.dismissed, self.since = set(), [], set(), self.now
            self.add_symptoms()

    def add_symptoms(self) -> None:
        assert self.case is not None
        self.case.add_symptoms(self.diagnosis.symptoms)
        self.symptoms |= set(self.diagnosis.symptoms)

    @precondition(lambda self: self.case is not None)
    @rule(
        found=st.sampled_from(("plan", "plan", "none", "late")),
        outcome=st.sampled_from((DONE, FAILED, SKIPPED)),
        share=st.sampled_from((0.1, 1.0)),
        helps=st.booleans(),
        slow=st.sampled_from((0.0, 0.0, 40.0)),
    )
    def go_on(self, found: str, outcome: str, share: float, helps: bool, slow: float = 0.0) -> None:
        assert self.case is not None
        case, decision = self.case, self.next or decide(self.case, self.moment(self.case), POLICY)
        self.next = None
        self.judge(decision)
        match decision:
            case Wait(seconds, wakes):
                # Something comes in at the latest when the mode does not forbid it any more.
                self.now += min(seconds, 100.0) * (share if wakes else 1.0)
            case Enter(phase):
                if case.phase is not None and self.was_held:
                    self.since = self.now
                self.was_held = decision.held.startswith("in mode")
                case.enter(phase, self.now)
            case PlanFor(bad):
                self.add_symptoms()
                self.now += slow
                self.next = self.plan(bad, found, outcome, helps)
            case Dismiss(bad, why):
                self.dismissed.add(bad)
                case.hopeless[bad] = why
            case GiveUp(components):
                self.given_up |= set(components)
                self.case = None
            case Close():
                self.case = None

    was_held = False

    def plan(self, bad: tuple[str, ...], found: str, outcome: str, helps: bool) -> Decision:
        assert self.case is not None
        case = self.case
        if self.mode == SAFE or found != "plan":
            none = TimedOut(5.0, "too slow") if found == "late" else Unsolvable((), False, "there is none")
            return judge_no_plan(case, bad, none, self.mode, POLICY)
        step = Step("mend", (bad[0],))
        case.begin_plan(bad, ())
        case.count(step)
        self.now += 0.5
        if outcome == DONE and helps:
            self.broken.discard(bad[0])
            self.diagnosed = self.now
        results = [Result(step, outcome, "" if outcome == DONE else "it is so")]
        if was_skipped(results):
            case.take_back_plan(bad)
        else:
            self.plans.append(bad)
        return judge_results(bad, Plan(((step,),)), results, self.now, POLICY)

    def judge(self, decision: Decision) -> None:
        """What the model says of a decision."""
        assert self.case is not None
        diagnosis, seen = self.diagnosis, self.observed
        match decision:
            case PlanFor(bad):
                assert diagnosis.state is State.FAULTY
                assert self.is_seen
                assert self.now >= self.settles
                assert bad not in self.dismissed
                assert not set(bad) <= self.given_up
                assert len(self.plans) < POLICY.rounds
                assert self.now - self.since <= POLICY.seconds
            case Wait(seconds, wakes):
                assert seconds > 0
                assert seconds < math.inf or (wakes and self.mode == SAFE and diagnosis.state is State.FAULTY)
            case Close(True):
                # All symptoms are seen to have gone; or what is blamed now is not for this case to mend.
                gone = all(one.atom in seen.positive for one in self.symptoms)
                assert gone if diagnosis.state is State.HEALTHY else self.chosen(self.case) is None
            case GiveUp(components):
                assert not set(components) - set(PARTS)
            case Enter() | Dismiss() | Close():
                pass

    @invariant()
    def what_is_counted_is_so(self) -> None:
        if self.case is not None:
            assert self.case.rounds == sum(self.case.tried.values()) == len(self.plans)
            assert set(self.case.symptoms) == self.symptoms
            assert self.case.hopeless.keys() == self.dismissed

    def teardown(self) -> None:
        """Whatever has happened, a case ends when nothing happens any more but in a mode that forbids everything."""
        self.mode, decisions = NORMAL, 0
        ends = self.now + POLICY.seconds + POLICY.rounds * (POLICY.verify + 1.0) + POLICY.unknown + 50.0
        while self.case is not None:
            self.go_on("plan", DONE, 1.0, helps=False)
            decisions += 1
            assert decisions < MOST_DECISIONS
            assert self.now < ends


TestRepair = Repair.TestCase
TestRepair.settings = settings(max_examples=200, stateful_step_count=50, deadline=None)
