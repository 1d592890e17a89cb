"""Decides the next step in a case of repair, purely from the case and what is known at one moment.

A case goes round: choose a diagnosis, plan for it, carry the plan out, wait until the symptoms are seen to have gone.
In each phase `decide` says what comes next, until it says `Close` or `GiveUp`; `judge_results` says it after a plan,
`judge_no_plan` when none was found.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Final, NamedTuple

from ..engine import State
from ..literals import Literal
from ..model import Model
from ..planning import Plan, Step, TimedOut, Unsolvable
from .case import Case, Finishing, HeldByMode, Phase, Unclear, Verifying, Watching
from .choice import CaseView, remaining, symptoms_held
from .executor import DONE, SKIPPED, Result
from .outlook import Outlook
from .policy import Policy

SOON: Final = 1.0
"""Seconds until it is looked again whether a supervisor has done its work."""


class Wait(NamedTuple):
    """Wait so many seconds; with `wakes` no longer than until something comes in."""

    seconds: float
    wakes: bool = False


class Enter(NamedTuple):
    """Go on in another phase (None: with the next round), and tell why nothing is done, if something is said."""

    phase: Phase | None = None
    held: str = ""


class PlanFor(NamedTuple):
    """Plan for this candidate, and carry the plan out."""

    bad: tuple[str, ...]


class Dismiss(NamedTuple):
    """Try this candidate no more in this case: nothing can be done for it."""

    bad: tuple[str, ...]
    why: str


class GiveUp(NamedTuple):
    """Say that these components are beyond repair, and end the case."""

    components: tuple[str, ...]
    why: str


class Close(NamedTuple):
    """End the case; with `is_repaired` as a success."""

    is_repaired: bool


Decision = Wait | Enter | PlanFor | Dismiss | GiveUp | Close


def decide(case: Case, at: CaseView, policy: Policy) -> Decision:
    """What to do now in the phase that the case is in."""
    match case.phase:
        case None:
            return _decide_round(case, at, policy)
        case Verifying(touched, since, ends):
            return _decide_verifying(case, at, policy, touched, since, ends)
        case Finishing(ends):
            return _decide_finishing(case, at, ends)
        case Unclear(why, ends):
            if not why_unknown(at):
                return Enter()
            return Wait(ends - at.now, wakes=True) if at.now < ends else GiveUp((), f"{why} for {policy.unknown:g} s")
        case HeldByMode(mode):
            is_held = at.mode == mode and at.diagnosis.state is State.FAULTY
            return Wait(math.inf, wakes=True) if is_held else Enter()
        case Watching(bad):
            is_same = at.stance == "advise" and at.bad in (None, bad, *case.advised)
            is_same = is_same and at.diagnosis.state is not State.HEALTHY
            return Wait(math.inf, wakes=True) if is_same else Enter()


def _decide_round(case: Case, at: CaseView, policy: Policy) -> Decision:
    if at.settles > at.now:
        return Wait(at.settles - at.now)
    if at.diagnosis.state is State.HEALTHY:
        return Enter(Finishing(at.now + policy.verify))
    if why := why_unknown(at):
        return Enter(Unclear(why, at.now + policy.unknown), held=why)
    if at.bad is None:
        return _decide_nothing_left(case, at)
    if case.rounds >= policy.rounds or at.now - case.began > policy.seconds:
        limit = f"{case.rounds} plans in {at.now - case.began:.3g} s have not helped"
        return GiveUp(at.diagnosis.suspects, limit)
    return PlanFor(at.bad)


def _decide_nothing_left(case: Case, at: CaseView) -> Decision:
    """No candidate is open: what is left was given up before, cannot be planned for, or is not ours to touch."""
    if not case.hopeless:
        return Close(is_repaired=True)
    suspects = (name for bad in case.hopeless for name in bad if name not in at.given_up)
    return GiveUp(tuple(dict.fromkeys(suspects)), next(iter(case.hopeless.values())))


def _decide_verifying(
    case: Case, at: CaseView, policy: Policy, touched: Collection[str], since: float, ends: float
) -> Decision:
    """Wait until the symptoms have gone; no longer, once a stable diagnosis blames others than were touched."""
    is_healthy = at.diagnosis.state is State.HEALTHY and not remaining(case.symptoms, at.observed)
    left = ends - at.now
    if left <= 0 or is_healthy:
        return Enter()
    quiet = max(since, at.diagnosed) + policy.settle - at.now
    if quiet > 0:
        return Wait(min(left, quiet), wakes=True)
    blames_others = at.bad is None or not set(touched) & set(at.bad)
    return Enter() if blames_others else Wait(left, wakes=True)


def _decide_finishing(case: Case, at: CaseView, ends: float) -> Decision:
    """The diagnosis finds nothing bad: it counts when the symptoms are seen to have gone."""
    if at.diagnosis.state is not State.HEALTHY:
        return Enter()
    left = remaining(case.symptoms, at.observed)
    if not left and (at.now >= ends or not at.is_unsure):
        return Close(is_repaired=True)
    if at.now >= ends:
        return GiveUp((), f"nothing is blamed any more, but {', '.join(map(str, left))} was not seen to have gone")
    return Wait(ends - at.now, wakes=True)


def why_unknown(at: CaseView) -> str:
    """Why it is not known what there is to repair; empty if it is.

    No repair starts from observations that say nothing or cannot all be true (T49, T50).
    """
    state = at.diagnosis.state
    if state in (State.BLIND, State.CONTRADICTORY):
        return f"the observations are {state.value}"
    if state is State.FAULTY and not symptoms_held(at.diagnosis.symptoms, at.observed):
        return "nobody observes any more what was diagnosed"
    return ""


def judge_no_plan(
    case: Case, bad: tuple[str, ...], outcome: Plan | Unsolvable | TimedOut, mode: str, policy: Policy
) -> Decision:
    """What follows when no plan was found for a candidate.

    Args:
        mode: the one that it was planned in; it may be another one by now.
    """
    if isinstance(outcome, TimedOut):
        return Dismiss(bad, f"no plan was found: {outcome.why}")
    if mode in policy.modes:
        return Enter(HeldByMode(mode), held=f"in mode {mode} nothing can be done for {', '.join(bad)}")
    why = "nothing is left to try" if any(case.tries.get(name) for name in bad) else "there is no way to repair it"
    return Dismiss(bad, f"{why}; {case.failures[-1]}" if case.failures else why)


def judge_pings(
    case: Case,
    bad: tuple[str, ...],
    pings: Mapping[str, bool | None],
    at: CaseView,
    policy: Policy,
) -> Decision | None:
    """What to do instead of restarting actors on suspicion; None: restart them.

    Who does not answer is restarted at once. Who answers is restarted when the diagnosis has stood for a while, or what
    shows it has, if nobody else may be faulty; and never because somebody says that it does not run: that word is seen
    to be wrong.

    Args:
        pings: whether their actors answer; None: suspended by order. Of one that is no actor nothing is known.
    """
    if suspended := [name for name, answer in pings.items() if answer is None]:
        return Dismiss(bad, f"{', '.join(suspended)} was suspended by order")
    alive = [name for name, answer in pings.items() if answer]
    if not alive or len(alive) < len(pings):
        case.doubted.pop(bad, None)
        return None
    since = case.doubted.setdefault(bad, at.now)
    if set(bad) <= set(at.diagnosis.certain):  # Nobody else may be it: what shows it has stood already.
        since = min(since, at.stood)
    if (left := since + policy.caution.confirm - at.now) > 0:  # What is waited for is what is asked: both round alike.
        return Wait(left)
    down = {one.args[0] for one in at.diagnosis.symptoms if one.name == "running" and not one.positive}
    if wrong := [name for name in alive if name in down]:
        return Dismiss(bad, f"{', '.join(wrong)} runs and answers, although it is said not to run")
    return None


def judge_results(bad: tuple[str, ...], plan: Plan, results: Sequence[Result], now: float, policy: Policy) -> Decision:
    """What follows when a plan was carried out."""
    if any(result.outcome == DONE for result in results):
        touched = frozenset(name for step in plan.steps for name in step.args[:1])
        return Enter(Verifying(touched, now, now + policy.verify))
    if was_skipped(results):
        return Wait(max(policy.cool_down, 1.0))
    return Enter()


def was_skipped(results: Sequence[Result]) -> bool:
    """Whether nothing of a plan was tried: somebody else is at it, or the world has moved on."""
    return all(result.outcome == SKIPPED for result in results)


def is_unsure(case: Case, model: Model, outlook: Outlook, now: float) -> bool:
    """Whether something depends on whom we touched, was known in this case, and is not seen to hold now (T56).

    Within its grace period a topic that is still silent is neither good nor bad: nobody knows yet.
    """
    seen = (outlook.seen(atom, now) for atom in model.dependents(case.tries))
    return any(when >= case.began and not value for value, when in seen)


def seen_again(case: Case, outlook: Outlook, now: float) -> set[Literal]:
    """The symptoms that the present plan was to mend, and that are diagnosed by words from behind its grace."""
    if not isinstance(case.phase, Verifying) or outlook.diagnosis.state is not State.FAULTY:
        return set()
    behind = max(case.phase.since, outlook.graced)
    said = {
        word.literal
        for symptom in outlook.diagnosis.symptoms
        for word in outlook.observations.words(symptom)
        if word.time > behind and word.is_current(now)
    }
    return {symptom for symptom in case.plan.aims if symptom in said}


def vain_in(case: Case, model: Model) -> set[str]:
    """Whom the present plan has touched in vain: all that it was to mend there was seen again, whatever comes later."""
    vain = set[str]()
    for name in case.plan.midway:
        theirs = case.plan.aims & {literal for atom in model.dependents((name,)) for literal in (atom, ~atom)}
        if theirs and theirs <= case.plan.seen_again:
            vain.add(name)
    return vain


def why_overtaken(step: Step, case: Case, outlook: Outlook, policy: Policy, mode: str, now: float) -> str:
    """Why a step is not to be done any more; empty if it is.

    What was begun is not left halfway: a base that was switched off is switched on again.
    """
    target = step.args[0] if step.args else ""
    if not policy.may(step.action, mode):
        return f"mode {mode} does not allow it"
    if now < outlook.theirs.get(target, -math.inf):
        return f"somebody else has just started {target}"
    if target in case.plan.midway:
        return ""
    diagnosis = outlook.diagnosis
    if diagnosis.state is State.CONTRADICTORY:
        return "the observations are contradictory"
    if now < outlook.graced:
        return ""  # Nobody is blamed for a while: to be found good means nothing then.
    if target in case.plan.blamed and diagnosis.is_complete and target not in diagnosis.suspects:
        return f"a new diagnosis finds {target} good"
    return ""
