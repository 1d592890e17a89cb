"""A machine takes an actor from place to place, kills it and lets time pass, under asks and tells in any schedule.

`HOLDFAST_TRAVELS=n` makes n examples of each machine.
"""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import hypothesis.strategies as st
import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis.stateful import initialize, invariant, precondition, rule, run_state_machine_as_test

import holdfast as hf
from holdfast.actors.migration.move import Move
from holdfast.testing import ActorMachine, Model
from tests.migration.travellers import BELOW, OWN_BELOW, Add, Luggage, Traveller, path, take, tree

EXAMPLES = int(os.environ.get("HOLDFAST_TRAVELS", "8"))
PLACES = ("a task", "a process", "replicas", BELOW, OWN_BELOW)


def counted(total: int, message: Add) -> tuple[int, int]:
    return total + message.n, total + message.n


class Travels(ActorMachine):
    """One traveller with all its luggage. What it is taken to goes on while the next rules add, kill and wait.

    Attributes:
        kind: how it is recovered.
        isolation: "task" or "process": how it lives where it has no mechanism; `is_protected`: whether it has one.
        is_struck: whether something was killed since the step began; `may_fail`: or just before, or it was given up.
        told: the sum of what was added.
    """

    model = Model(0, counted)
    options: ClassVar[Mapping[str, Any]] = {"intensity": 1000}
    latency = (0.0, 0.01)
    kind: ClassVar[str] = "recorded"

    def set_up(self) -> None:
        self.start(hf.supervisor("there", intensity=1000))
        self.told, self.step = 0, ""
        self.is_struck = self.may_fail = False
        self.taking: asyncio.Future[None] | None = None

    @initialize(place=st.sampled_from(PLACES))
    def live(self, place: str) -> None:
        self.start(tree(place, self.kind))
        self.ref = self.system.ref(path(place), Traveller)
        self.isolation = "process" if place in ("a process", OWN_BELOW) else "task"
        self.is_protected = place == "replicas"
        self.luggage = Luggage(self.system, self.ref)
        self.run(self.luggage.pack())

    @rule(amount=st.integers(1, 9))
    def add(self, amount: int) -> None:
        self.ask(self.ref, Add(amount), 120.0)
        self.told += amount

    @rule(amount=st.integers(1, 9))
    def add_unheard(self, amount: int) -> None:
        self.tell(self.ref, Add(amount))
        self.told += amount

    @rule(number=st.integers(0, 2), is_given_up=st.booleans())
    def begin(self, number: int, is_given_up: bool) -> None:
        """Take the next step, which is given up at the instant at which the old life is at rest, or is not."""
        self.arrive()
        isolation = "task" if self.isolation == "process" else "process"
        step = (isolation, "unprotect" if self.is_protected else "protect", "move")[number]
        self.step, self.may_fail, self.is_struck = step, is_given_up or self.is_struck, False

        async def begins() -> None:
            GivenUp.is_next = is_given_up
            self.taking = asyncio.ensure_future(take(self.system, self.ref, step))
            await asyncio.sleep(0)

        self.run(begins())

    @precondition(lambda self: self.taking is not None)
    @rule()
    def arrive(self) -> None:
        """Wait for the step; if it was struck and has failed, take it again."""
        if self.taking is None:
            return
        taking, self.taking = self.taking, None

        async def outcome(taking: asyncio.Future[None]) -> None:
            for _ in range(5):
                try:
                    await taking
                    return
                except (hf.errors.CannotMove, hf.TransactionFailed):
                    assert self.is_struck or self.may_fail
                    await asyncio.sleep(1.0)  # A process that was killed is started again.
                    GivenUp.is_next = False
                    taking = asyncio.ensure_future(take(self.system, self.ref, self.step))
            await taking

        self.run(outcome(taking))
        GivenUp.is_next = False
        if self.step in ("task", "process"):
            self.isolation = self.step
        elif self.step in ("protect", "unprotect"):
            self.is_protected = self.step == "protect"

    @rule(seconds=st.sampled_from((0.01, 0.3, 3.0)))
    def let_time_pass(self, seconds: float) -> None:
        self.advance(seconds)

    @precondition(lambda self: self.taking is None)
    @invariant()
    def it_has_one_address(self) -> None:
        assert [address for address in self.system.tree() if address.endswith("/one")] in ([], [self.ref.path])

    @invariant()
    def nothing_is_lost_on_the_way(self) -> None:
        assert self.system.dead_letters == 0

    def teardown(self) -> None:
        try:
            if sys.exc_info()[1] is None:  # Else the example has ended already.
                self.arrive()
                self.idle()
                seen = self.run(self.luggage.unpack())
                assert sum(seen["added"]) == self.told
        finally:
            super().teardown()


class KilledTravels(Travels):
    """The same, and once in each step its life is ended, or the process in which it lives, or one of two replicas."""

    @precondition(lambda self: not (self.is_struck or self.is_protected or self.step == "protect"))
    @rule()
    def crash(self) -> None:
        self.is_struck = True
        self.crash_actor(self.ref)

    @precondition(lambda self: not self.is_struck)
    @rule(first=st.booleans())
    def kill(self, first: bool) -> None:
        processes = sorted(one for one in self.system._workers.processes() if one.startswith(self.ref.path))
        if processes and (len(processes) == 1) != self.is_protected:
            self.is_struck = True
            self.kill_process(self.system.ref(processes[0 if first else -1], hf.Actor))


class PlainTravels(Travels):
    kind = "plain"


class GivenUp:
    """Whether the next attempt ends at the instant at which the old life is at rest."""

    is_next: ClassVar[bool] = False


@pytest.fixture(autouse=True)
def attempts(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    at_rest = Move.at_rest

    def given_up(move: Move) -> None:
        at_rest(move)
        if GivenUp.is_next:
            GivenUp.is_next = False
            move.give_up("the time is over")

    monkeypatch.setattr(Move, "at_rest", given_up)
    yield
    GivenUp.is_next = False


@pytest.mark.parametrize("machine", [Travels, KilledTravels, PlainTravels])
def test_whoever_travels_loses_doubles_and_reorders_nothing(machine: type[Travels]) -> None:
    drawn = settings(
        max_examples=EXAMPLES,
        stateful_step_count=25,
        deadline=None,
        derandomize="HOLDFAST_TRAVELS" not in os.environ,
        database=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much],
        phases=[Phase.generate, Phase.shrink],
    )
    run_state_machine_as_test(machine, settings=drawn)
