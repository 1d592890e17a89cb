"""Faults of real machines: servers, programs, disks, clocks and the network between them fail, and nothing is lost.

`HOLDFAST_MACHINES=1000` has so many faults, drawn by `HOLDFAST_SEED`: ten for each fleet. Without it, chosen ones.
"""

from __future__ import annotations

import os
import random
from pathlib import Path
from time import monotonic

import pytest

from tests.cluster.machines.fleet_of_machines import FleetOfMachines, Kind
from tests.cluster.machines.machine_faults import MOMENTS, STRIKES, Fault, commit
from tests.cluster.machines.namespaces import WHY_NOT

SEED = int(os.environ.get("HOLDFAST_SEED", "19"))
FAULTS = int(os.environ.get("HOLDFAST_MACHINES", "0"))
OF_A_FLEET = 10
CHOSEN: dict[Kind, list[Fault]] = {
    "network": [
        Fault("in calm", "cut off the leader with one server"),
        Fault("at a snapshot", "cut off the log's server again and again"),
        Fault("in calm", "cut off the standby with one server"),
        Fault("in calm", "fill the disk of another server"),
        Fault("at a snapshot", "slow down the disk of the log's server"),
        Fault("at a snapshot", "stop the standby"),
    ],
    "links": [
        Fault("in calm", "have links be late"),
        Fault("in calm", "kill the worker"),
        Fault("at a snapshot", "break links"),
        Fault("in calm", "stop another server"),
        Fault("at a snapshot", "kill the standby"),
        Fault("in calm", "stop the leader"),
    ],
}
KINDS = [
    pytest.param("network", marks=pytest.mark.skipif(bool(WHY_NOT), reason=WHY_NOT or "there are namespaces")),
    "links",
]


async def outlive(folder: Path, kind: Kind, seed: int, isolation: str, faults: list[Fault]) -> None:
    """Have a fleet outlive these faults, one after another."""
    fleet = FleetOfMachines(folder, kind, seed, isolation)
    done: list[str] = []
    try:
        await fleet.start()
        for fault in faults:
            began = monotonic()
            done.append(str(fault))
            await commit(fleet, fault)
            done[-1] += f" ({monotonic() - began:.1f} s)"
        await fleet.judge()
        print(f"{kind}, seed {seed}, {isolation}; outlived: {'; '.join(done)}")
    except BaseException as error:
        error.add_note(f"{kind}, seed {seed}, {isolation}; faults: {'; '.join(done)}\n{fleet.said()}")
        raise
    finally:
        await fleet.close()


@pytest.mark.asyncio(loop_factories=["asyncio"])
@pytest.mark.parametrize("kind", KINDS)
async def test_nothing_is_lost_whatever_fails(tmp_path: Path, kind: Kind) -> None:
    await outlive(tmp_path, kind, SEED, "process" if kind == "links" else "task", CHOSEN[kind])


def drawn(number: int) -> tuple[Kind, str, list[Fault]]:
    """What a fleet of the campaign has to outlive."""
    draws = random.Random(f"{SEED} {number}")
    kind: Kind = draws.choice(["network", "links"]) if not WHY_NOT else "links"
    isolation = draws.choice(["task", "process"])
    possible = [
        name
        for name, strike in STRIKES.items()
        if kind in strike.kinds and (isolation == "process" or not name.endswith("worker"))  # Else there is none.
    ]
    return kind, isolation, [Fault(draws.choice(MOMENTS), draws.choice(possible)) for _ in range(OF_A_FLEET)]


@pytest.mark.skipif(not FAULTS, reason="a campaign: HOLDFAST_MACHINES=1000 has so many faults")
@pytest.mark.asyncio(loop_factories=["asyncio"])
@pytest.mark.parametrize("number", range(-(-FAULTS // OF_A_FLEET)))
async def test_nothing_is_lost_over_many_faults(tmp_path: Path, number: int) -> None:
    kind, isolation, faults = drawn(number)
    await outlive(tmp_path, kind, number, isolation, faults)
