"""A mechanism masks every single fault that it claims, at each step of a request: nothing is lost, wrong or done twice.

A44-A59. Here a few faults of a few rows, by the seed (`HOLDFAST_SEED`); `HOLDFAST_REQUESTS=10000` has all rows run,
at all steps. `benchmarks/bench_ftm.py --only campaign` prints the whole table.
"""

from __future__ import annotations

import dataclasses
import os
from typing import Any

import pytest

from tests.ftm.campaign import Row, cell, run_row, table
from tests.ftm.faults import KINDS, claims, makes_sense
from tests.ftm.stacks import STACKS

SEED = os.environ.get("HOLDFAST_SEED", "20261121")
REQUESTS = int(os.environ.get("HOLDFAST_REQUESTS", "60"))
IS_LONG = "HOLDFAST_REQUESTS" in os.environ
FAULTS = 40 if IS_LONG else 2
SHORT = {
    ("PBR", "crash of a root part"), ("PBR", "message doubled"), ("LFR", "crash of a brick"),
    ("TR", "state, transient"), ("AD+PBR", "answer, permanent"), ("RB", "bug of the class"),
    ("NVP", "answer, transient"), ("TMR", "state, permanent"), ("SEC+PBR+TR", "frame altered"),
    ("LFR+TR", "crash of a replica"), ("PBR+own", "state, transient"),
}  # fmt: skip
"""Each mechanism once. Crashes, stops and forged frames are struck by other tests too."""
ROWS = [
    (name, kind)
    for name, make in STACKS.items()
    for kind in KINDS
    if makes_sense(make("counter"), kind) and claims(make("counter"), kind)
    if IS_LONG or (name, kind) in SHORT
]

pytestmark = pytest.mark.asyncio(loop_factories=["uvloop"])


async def kept(name: str, kind: str, workload: str = "counter") -> None:
    layers: Any = STACKS[name](workload)
    row = await run_row(name, layers, kind, workload, requests=REQUESTS, most=FAULTS, seed=SEED)
    assert row.injected or kind == "nothing", row.unreached
    assert row.is_kept, f"{row}\n" + "\n".join(row.trouble)


@pytest.mark.parametrize(("name", "kind"), ROWS)
async def test_a_claimed_fault_is_masked(name: str, kind: str) -> None:
    """A67."""
    if name.startswith("SEC"):
        pytest.importorskip("cryptography")
    await kept(name, kind)


@pytest.mark.parametrize(("name", "workload"), [("PBR", "bank"), ("LFR", "store")])
async def test_crashes_of_replicas_are_masked_for_other_workloads(name: str, workload: str) -> None:
    """Transfers between two accounts by asks in the middle of a turn; a store whose history is linearizable."""
    await kept(name, "crash of a replica", workload)


async def test_a_value_fault_that_is_not_claimed_is_seen_by_the_campaign() -> None:
    """Else the rows of the others would say nothing: passive replication copies a wrong state."""
    row = await run_row("PBR", STACKS["PBR"]("counter"), "state, transient", requests=60, most=2, seed=SEED)
    assert row.injected == 2
    assert row.silent >= 1
    assert row.wrong >= 1
    assert "**" not in cell([row], "PBR", "state, transient")


async def test_a_row_that_breaks_its_promise_is_known() -> None:
    whole = Row("PBR", "counter", "SIGSTOP", claimed=True, requests=9, injected=2, masked=2)
    assert whole.is_kept
    wrongs: tuple[dict[str, Any], ...] = (
        {"masked": 1}, {"lost": 1}, {"wrong": 1}, {"doubled": 1}, {"failed": 1}, {"stuck": "at 3"},
    )  # fmt: skip
    for wrong in wrongs:
        assert not dataclasses.replace(whole, **wrong).is_kept
    assert table([whole]).splitlines()[-1] == "| SIGSTOP | **2 of 2** |"
