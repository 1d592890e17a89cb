"""A mechanism masks every single fault that it claims, at each step of a request: nothing is lost, wrong or done twice.

A44 to A59. `HOLDFAST_CAMPAIGN=10000` is the number of requests for each row of the long campaign, `HOLDFAST_SEED`
another order of faults. `benchmarks/bench_ftm.py --only faults` prints the whole table.
"""

from __future__ import annotations

import os
from typing import Any

import pytest

import holdfast as hf
from tests.ftm.campaign import KINDS, claims, makes_sense, run_row

SEED = os.environ.get("HOLDFAST_SEED", "20261121")
REQUESTS = int(os.environ.get("HOLDFAST_CAMPAIGN", "60"))
IS_LONG = "HOLDFAST_CAMPAIGN" in os.environ
FAULTS = 10_000 if IS_LONG else 2
"""Of each row; in the short run some of the steps, by the seed."""
STACKS: dict[str, tuple[Any, ...]] = {
    "PBR": (hf.PBR(),),
    "LFR": (hf.LFR(),),
    "TR": (hf.TR(),),
    "PBR+TR": (hf.PBR(), hf.TR()),
    "LFR+TR": (hf.LFR(), hf.TR()),
}
SHORT = (
    "crash of a replica",
    "crash of a brick",
    "crash while joining",
    "crash of a root part",
    "SIGSTOP",
    "message doubled",
    "message reordered",
)
"""Kinds of the short run, for single mechanisms."""
ROWS = [
    (name, kind)
    for name, layers in STACKS.items()
    for kind in KINDS
    if makes_sense(layers, kind) and claims(layers, kind)
    if IS_LONG or (name in ("PBR", "LFR") and kind in SHORT) or (name in ("TR", "PBR+TR") and "transient" in kind)
]

pytestmark = pytest.mark.asyncio(loop_factories=["uvloop"])


@pytest.mark.parametrize(("name", "kind"), ROWS)
async def test_a_claimed_fault_is_masked(name: str, kind: str) -> None:
    row = await run_row(name, STACKS[name], kind, requests=REQUESTS, most=FAULTS, seed=SEED)
    assert row.injected or kind == "nothing", row.unreached
    assert row.is_kept, f"{row}\n" + "\n".join(row.trouble)


@pytest.mark.parametrize("workload", ["bank", "store"])
@pytest.mark.parametrize("name", ["PBR", "LFR"])
async def test_crashes_of_replicas_are_masked_for_other_workloads(name: str, workload: str) -> None:
    """Transfers between two accounts by asks in the middle of a turn; a store whose history is linearizable."""
    row = await run_row(name, STACKS[name], "crash of a replica", workload, requests=REQUESTS, most=FAULTS, seed=SEED)
    assert row.injected, row.unreached
    assert row.is_kept, f"{row}\n" + "\n".join(row.trouble)


async def test_a_value_fault_that_is_not_claimed_is_seen_by_the_campaign() -> None:
    """Else the rows of the others would say nothing: passive replication copies a wrong state."""
    row = await run_row("PBR", STACKS["PBR"], "state, transient", requests=60, most=2, seed=SEED)
    assert row.injected == 2
    assert row.silent >= 1
    assert row.wrong >= 1
