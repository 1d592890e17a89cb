"""Repair planning: what to do, in which order and what at the same time, so that everything works again.

A domain (what can be done) is PDDL text; ours is `repair.pddl`. A problem (what is so, what should be) is made of a
diagnosis by `repair_problem`, or read from PDDL. `find_plan` asks a `Planner` in a thread, within a time limit.
"""

from .answers import Budget, Outcome, Plan, Planner, Step, TimedOut, Unsolvable
from .finding import find_plan
from .language import Domain, PlanningError, Problem
from .pddl_reader import read_domain, read_problem, with_actions
from .plan_check import InvalidPlan, Simulator, check_plan
from .repair import repair_domain, repair_problem
from .stable import ClingoPlanner

__all__ = [
    "Budget",
    "ClingoPlanner",
    "Domain",
    "InvalidPlan",
    "Outcome",
    "Plan",
    "Planner",
    "PlanningError",
    "Problem",
    "Simulator",
    "Step",
    "TimedOut",
    "Unsolvable",
    "check_plan",
    "find_plan",
    "read_domain",
    "read_problem",
    "repair_domain",
    "repair_problem",
    "with_actions",
]
