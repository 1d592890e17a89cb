"""From an observer's word to a mechanism that masks the fault: diagnosis, plan, transaction, with real processes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.diagnosis import observer, tree
from holdfast.diagnosis.messages import REPAIR
from holdfast.diagnosis.model import Model, System
from holdfast.diagnosis.observers import Check, DiagnosticObserver, Limits, Manner
from holdfast.diagnosis.repair import (
    ActionBegan,
    GaveUp,
    Policy,
    RepairAction,
    Repaired,
    Repairer,
    protect_by,
)
from holdfast.testing import probe
from tests.ftm.accounts import Add, Counter, Load, Tags
from tests.ftm.test_adaptation import stack

# Processes do not care which event loop the root has.
pytestmark = pytest.mark.asyncio(loop_factories=["uvloop"])

ALICE = {"alice": "/app/alice"}
RARELY = 11
"""One of so many computations goes wrong: in three runs of two requests, one at most."""
LATEST = 2 * RARELY
"""Readings that have to be right, all of them, for alice to be believed."""


class Reading(hf.Message):
    value: int


class Gauge(Counter):
    """Publishes what it has counted; while there is a file, its hardware goes wrong now and then."""

    def __init__(self, noise: str) -> None:
        super().__init__()
        self._noise = noise
        self._runs = 0  # of this process: no state, which a fault of the hardware is not either

    @hf.on(Add)
    async def add(self, message: Add) -> int:  # type: ignore[override]  # pyright: ignore[reportIncompatibleMethodOverride]
        self.total += message.amount
        self.tags.append(message.tag)
        self._runs += 1
        is_wrong = self._runs % RARELY == 0 and os.path.exists(self._noise)
        await self.ctx.publish("/readings", Reading(-1 if is_wrong else self.total))
        return self.total


class Lowest:
    """The lowest of the latest values."""

    def __init__(self) -> None:
        self._values: list[float] = []

    def __call__(self, value: float) -> float:
        self._values = [*self._values[-LATEST + 1 :], value]
        return min(self._values)


def diagnosed(*actions: RepairAction) -> hf.ChildSpec:
    """Alice publishes readings, which are never negative; repair may do these."""
    declared = System()
    declared.node("alice", out=["/readings"])
    check = Check("ok(/readings)", "value", Limits(low=-0.5), Lowest)
    looks = observer("readings", hf.start(DiagnosticObserver, "/readings", [check], manner=Manner(every=0.2)))
    policy = Policy(verify=20.0, settle=1.0)
    base = "/app/diagnosis"
    repairer = hf.child(
        "repairer",
        hf.start(
            Repairer, Model(declared), actions, policy, addresses=ALICE, base=[base], diagnoser=f"{base}/diagnoser"
        ),
    )
    return tree(declared, [looks], repairer=repairer)


async def test_a_suspected_value_fault_leads_to_time_redundancy_while_requests_flow(
    system: hf.ActorSystem, tmp_path: Path
) -> None:
    """A24, T63: the observer sees wrong values, repair composes TR into the group, and they are masked from then on."""
    noise = tmp_path / "noise"
    ref = await system.start(hf.child("alice", hf.start(Gauge, str(noise)), mechanism=hf.ftm.PBR()))
    heard = probe(system)
    heard.subscribe(REPAIR)
    load = Load(ref, clients=2)
    await load.reached(LATEST)
    await system.start(diagnosed(protect_by(system.transaction, ("pbr", "tr"), ALICE)))
    await load.reached(LATEST)
    noise.touch()
    begun = await heard.fish(ActionBegan, timeout=60.0)
    assert str(begun.step) == "protect_pbr_tr(alice)"
    ended: object = await heard.fish(lambda one: isinstance(one, (Repaired, GaveUp)), timeout=60.0)
    assert isinstance(ended, Repaired)
    assert noise.exists()
    assert stack(ref) == ("pbr", "tr")
    readings = probe(system)
    readings.subscribe("/readings")
    await load.reached(5 * RARELY)
    await load.stop()
    load.check(await ref.ask(Tags()))
    values = [one.value for one in readings.waiting if isinstance(one, Reading)]
    assert len(values) >= 5 * RARELY
    assert min(values) > 0
    assert ref._cell.life == 1


async def test_mechanisms_by_name_in_the_repertoire(system: hf.ActorSystem) -> None:
    names: list[Any] = [
        protect_by(system.transaction, "pbr", ALICE),
        protect_by(system.transaction, "lfr", ALICE, cost=3),
        protect_by(system.transaction, hf.ftm.TR(), ALICE, name="repeat"),
        protect_by(system.transaction, (hf.ftm.PBR(), "tr"), ALICE),
    ]
    assert [one.name for one in names] == ["protect_pbr", "protect_lfr", "repeat", "protect_pbr_tr"]
    assert "total-cost) 3" in names[1].pddl
