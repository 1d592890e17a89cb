"""What an actor says of the changes in its state reaches each replica once, though turns fail and runs begin anew."""

from __future__ import annotations

import os
import signal
from typing import Any

import pytest

import holdfast as hf
from tests.ftm.test_failover import two_again

IN_TIME = 25.0
UNLUCKY = 13


class Add(hf.Message[int]):
    at: int
    by: int


class Look(hf.Message[list[int]]): ...


class Ledger(hf.Actor):
    """Its deltas are sums: one that came twice, or was left out, is seen."""

    def __init__(self) -> None:
        self.sums = [0] * 10
        self._added: dict[int, int] = {}

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.sums[message.at] += message.by
        self._added[message.at] = self._added.get(message.at, 0) + message.by
        if message.by == UNLUCKY:
            raise ValueError("unlucky")
        return self.sums[message.at]

    @hf.on(Look)
    def look(self, message: Look) -> list[int]:
        return list(self.sums)

    def get_delta(self) -> dict[int, int]:
        added, self._added = self._added, {}
        return added

    def apply_delta(self, delta: dict[int, int]) -> None:
        for at, by in delta.items():
            self.sums[at] += by


def stacks() -> dict[str, Any]:
    return {
        "pbr": hf.ftm.PBR(),
        "lfr": hf.ftm.LFR(),
        "tmr": hf.ftm.TMR(),
        "pbr+tr": hf.ftm.compose(hf.ftm.PBR(), hf.ftm.TR()),
    }


@pytest.mark.parametrize("fails", [False, True], ids=["well", "failing"])
@pytest.mark.parametrize("name", list(stacks()))
async def test_each_delta_reaches_each_replica_once(name: str, fails: bool) -> None:
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        ref = await system.start(hf.child("ledger", hf.start(Ledger), mechanism=stacks()[name]))
        expected = [0] * 10
        for killed in range(2):
            await two_again(ref)
            for number in range(40):
                by = UNLUCKY if fails and number % 7 == 3 else 1
                try:
                    expected[number % 10] = await ref.ask(Add(number % 10, by), timeout=IN_TIME)
                except hf.RemoteCrash:
                    assert by == UNLUCKY
            assert await ref.ask(Look(), timeout=IN_TIME) == expected
            first = system.ref(f"/app/ledger/ftm/r{1 + killed}", hf.Actor)
            os.kill(system.pid_of(first), signal.SIGKILL)
            assert await ref.ask(Look(), timeout=IN_TIME) == expected
