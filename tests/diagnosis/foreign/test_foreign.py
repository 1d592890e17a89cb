"""Systems that know nothing of diagnosis: the root cause of a fault is named first, and changed traffic is no fault."""

import os
import random
import statistics

import pytest

from tests.diagnosis.foreign.systems import SYSTEMS, Foreign
from tests.diagnosis.foreign.trials import TRAFFICS, Outcome, trial

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])

ALL = [
    (foreign, fault, kind)
    for foreign in SYSTEMS
    for fault in foreign.faults
    for kind in TRAFFICS
    if (fault[1], kind) != ("lag", "quiet")  # Who is slower than before, and keeps up, is no fault.
]
TRIALS = int(os.environ.get("HOLDFAST_FOREIGN", "0"))
"""Rounds over all faults and traffics; 0: a small selection."""


@pytest.mark.parametrize("seed", [1])
@pytest.mark.parametrize("kind", TRAFFICS)
@pytest.mark.parametrize("foreign", SYSTEMS, ids=lambda foreign: foreign.name)
async def test_traffic_is_no_fault(foreign: Foreign, kind: str, seed: int) -> None:
    healthy = 24 * 3600.0 if TRIALS else 20.0
    assert (await trial(foreign, None, kind, seed, healthy)).false_alarms == ()


@pytest.mark.parametrize("number", range(6))
async def test_the_root_cause_is_named_first(number: int) -> None:
    foreign, fault, kind = random.Random(number).choice(ALL)
    print(f"{foreign.name}: {fault}, {kind} traffic, seed {number}")
    said = await trial(foreign, fault, kind, number)
    assert (said.false_alarms, said.first) == ((), (fault[0],))


async def test_of_many_faults_nearly_all_are_named() -> None:
    if not TRIALS:
        pytest.skip("the campaign sets HOLDFAST_FOREIGN, and has the time for it")
    wrong: list[tuple[str, tuple[str, str], str, int, Outcome]] = []
    outcomes: list[Outcome] = []
    for seed in range(TRIALS):
        for foreign, fault, kind in ALL:
            said = await trial(foreign, fault, kind, seed)
            outcomes.append(said)
            if said.first != (fault[0],) or said.false_alarms:
                wrong.append((foreign.name, fault, kind, seed, said))
    print(*wrong, sep="\n")
    alarms = sum(bool(one.false_alarms) for one in outcomes)
    median = statistics.median(one.seconds for one in outcomes)
    print(f"{len(outcomes)} trials, {len(wrong)} wrong, {alarms} with false alarms, named after {median:.1f} s")
    assert alarms == 0
    assert len(wrong) <= 0.05 * len(outcomes)
