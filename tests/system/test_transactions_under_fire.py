"""Transactions while clients ask, actors crash, callers give up and others change the tree too: all or nothing.

HOLDFAST_SEED repeats one seed; HOLDFAST_TRANSACTIONS=N has N seeds for each hazard, and actors in processes as often.
"""

import asyncio
import os

import pytest

from tests.system.transaction_machine import Found, Run, carry_out, found_by, limited
from tests.system.transaction_plans import HAZARDS, VERBS

RUNS = int(os.environ.get("HOLDFAST_TRANSACTIONS", "3"))
IS_LONG = "HOLDFAST_TRANSACTIONS" in os.environ
SEEDS = [int(os.environ["HOLDFAST_SEED"])] if "HOLDFAST_SEED" in os.environ else [*range(1, RUNS + 1)]
SLOWEST = 120.0
"""Seconds that a run with actors in processes may take."""
EVERYTHING = frozenset(HAZARDS)
IN_PROCESSES = (*VERBS, "isolation", "isolation", "isolation")


@pytest.mark.parametrize("hazards", [(), *((one,) for one in HAZARDS), HAZARDS], ids=["none", *HAZARDS, "all"])
def test_a_transaction_is_all_or_nothing_whatever_happens_meanwhile(hazards: tuple[str, ...]) -> None:
    for seed in SEEDS:
        run = Run(seed, frozenset(hazards))
        found = found_by(run, run.plan())
        if found is not None:
            pytest.fail(str(found), pytrace=False)


@pytest.mark.parametrize("hazards", [frozenset[str](), EVERYTHING], ids=["none", "all"])
def test_so_it_is_with_actors_in_processes(hazards: frozenset[str]) -> None:
    for seed in SEEDS if IS_LONG else SEEDS[:1]:
        run = Run(seed, hazards, rounds=8, verbs=IN_PROCESSES, processes=True)
        with asyncio.Runner() as runner:
            try:
                runner.run(limited(carry_out(run, run.plan(), end=30.0), SLOWEST))
            except Found as found:
                pytest.fail(str(found), pytrace=False)
