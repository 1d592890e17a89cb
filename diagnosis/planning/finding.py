"""Asking a planner without holding up the event loop, and what to do when not everything can be had."""

from __future__ import annotations

import asyncio
import contextlib

import msgspec

from ..engine.breath import beside_a_loop
from .answers import Budget, Outcome, OutOfTime, Plan, Planner, TimedOut, Unsolvable
from .language import PlanLiteral, Problem
from .plan_check import check_plan

GRACE = 1.0
"""Seconds a planner may take beyond its budget before it is left alone."""


async def find_plan(planner: Planner, problem: Problem, *, timeout: float = 10.0, degrade: bool = False) -> Outcome:
    """Plan in a worker thread, and check the plan before it is handed out.

    Args:
        planner: looks at its budget; one that does not is left behind in its thread.
        timeout: seconds for the search, > 0.
        degrade: if not all goals can be had, plan for those that can; the plan says which it has given up. The last of
            `problem.goals` are given up first.

    Returns:
        A plan; the proof that there is none (with `degrade`: none that would change anything); or that time is up.

    Raises:
        PlanningError: the problem is beyond what the planner takes. InvalidPlan: the planner is wrong.
    """
    if not timeout > 0:
        raise ValueError(f"timeout must be > 0 seconds, not {timeout!r}")
    budget = Budget(timeout)
    loop = asyncio.get_running_loop()
    # Not `to_thread` of anyio: a loop with a virtual clock must know that a thread is at work.
    work = loop.run_in_executor(None, _solve, planner, problem, budget, degrade)
    try:
        done, _ = await asyncio.wait((work,), timeout=timeout + GRACE)
    except asyncio.CancelledError:
        budget.cancel()
        _forget(work)
        raise
    if not done:
        budget.cancel()
        _forget(work)
        return TimedOut(timeout, "the planner does not keep to its time")
    return work.result()


def _forget(work: asyncio.Future[Outcome]) -> None:
    """Nobody waits any more: an error is nobody's."""
    work.add_done_callback(lambda done: done.cancelled() or done.exception())


def _solve(planner: Planner, problem: Problem, budget: Budget, degrade: bool) -> Outcome:
    with beside_a_loop():
        outcome = _what_can_be_had(planner, problem, budget) if degrade else planner.solve(problem, budget)
        if isinstance(outcome, Plan):
            check_plan(problem, outcome)
        return outcome


def _what_can_be_had(planner: Planner, problem: Problem, budget: Budget) -> Outcome:
    """Give up what is proven impossible, one after the other, and then see what need not have been given up."""
    goals, impossible, given_up = list(problem.goals), list[PlanLiteral](), list[PlanLiteral]()
    while True:
        outcome = planner.solve(problem.wanting(goals), budget)
        if not isinstance(outcome, Unsolvable):
            break
        blamed = [goal for goal in goals if goal in outcome.goals]
        if outcome.is_each:
            impossible += blamed
        else:
            given_up.append(blamed[-1])
            blamed = blamed[-1:]
        goals = [goal for goal in goals if goal not in blamed]
    if isinstance(outcome, TimedOut):
        return outcome
    # The last one given up stood in the way by itself; of those before it that is not certain.
    with contextlib.suppress(OutOfTime):
        for goal in given_up[:-1]:
            budget.check()
            wider = [one for one in problem.goals if one in goals or one == goal]
            better = planner.solve(problem.wanting(wider), budget)
            if isinstance(better, Plan):
                outcome, goals = better, wider
    unmet = tuple(goal for goal in problem.goals if goal not in goals)
    if unmet and not outcome.stages:
        return Unsolvable(unmet, not given_up, "what can be had is so already")
    return msgspec.structs.replace(outcome, unmet=unmet)
