"""A machine takes an actor from place to place, crashes it and lets time pass, under asks and tells in any schedule."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Mapping
from typing import Any, ClassVar

import hypothesis.strategies as st
import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis.stateful import invariant, precondition, rule, run_state_machine_as_test

import holdfast as hf
from holdfast.testing import ActorMachine, Model
from tests.migration.travellers import Add, Luggage, Traveller, path, take, tree

EXAMPLES = int(os.environ.get("HOLDFAST_TRAVELS", "6"))
STEPS = ("task", "process", "protect", "unprotect", "move")


def counted(total: int, message: Add) -> tuple[int, int]:
    return total + message.n, total + message.n


class Travels(ActorMachine):
    """One traveller with all its luggage; what was begun with it is awaited only when the next step begins.

    Attributes:
        kind: how it is recovered.
        lives_in: "task" or "process"; it lives there behind its mechanism, too.
        is_protected: whether it has one now.
    """

    model = Model(0, counted)
    options: ClassVar[Mapping[str, Any]] = {"intensity": 1000}
    latency = (0.0, 0.01)
    kind: ClassVar[str] = "recorded"

    def set_up(self) -> None:
        self.start(hf.supervisor("there", intensity=1000))
        self.start(tree("a task", self.kind))
        self.ref = self.system.ref(path("a task"), Traveller)
        self.lives_in, self.is_protected, self.is_struck = "task", False, False
        self.step = ""
        self.taking: asyncio.Future[None] | None = None
        self.luggage = Luggage(self.system, self.ref)
        self.run(self.luggage.pack())
        self.sums = 0

    @rule(amount=st.integers(1, 9))
    def add(self, amount: int) -> None:
        self.ask(self.ref, Add(amount), 120.0)
        self.sums += amount

    @rule(amount=st.integers(1, 9))
    def add_unheard(self, amount: int) -> None:
        self.tell(self.ref, Add(amount))
        self.sums += amount

    @rule(step=st.sampled_from(STEPS))
    def begin(self, step: str) -> None:
        """Take the next step, and go on before it is over."""
        self.arrive()
        if step == self.lives_in or (step in ("protect", "unprotect") and self.is_protected == (step == "protect")):
            return
        self.step, self.is_struck = step, False

        async def begins() -> None:
            self.taking = asyncio.ensure_future(take(self.system, self.ref, step))
            await asyncio.sleep(0)

        self.run(begins())

    @precondition(lambda self: self.taking is not None)
    @rule()
    def arrive(self) -> None:
        """Wait for the step that is being taken; if it was struck, take it again."""
        if self.taking is None:
            return
        taking, self.taking = self.taking, None

        async def outcome() -> None:
            try:
                await taking
            except (hf.errors.CannotMove, hf.TransactionFailed):
                assert self.is_struck
                await take(self.system, self.ref, self.step)

        self.run(outcome())
        if self.step in ("task", "process"):
            self.lives_in = self.step
        elif self.step in ("protect", "unprotect"):
            self.is_protected = self.step == "protect"

    @rule(seconds=st.sampled_from((0.01, 0.3, 3.0)))
    def let_time_pass(self, seconds: float) -> None:
        self.advance(seconds)

    @invariant()
    def it_has_one_address(self) -> None:
        if self.taking is None:
            assert len([address for address in self.system.tree() if address.endswith("/one")]) == 1

    @invariant()
    def nothing_is_a_dead_letter(self) -> None:
        assert self.system.dead_letters == 0

    def teardown(self) -> None:
        try:
            self.arrive()
            self.idle()
            seen = self.run(self.luggage.unpack())
            assert sum(seen["added"]) == self.sums
        finally:
            super().teardown()


class CrashedTravels(Travels):
    """The same, and it is killed, or the process that it lives in."""

    @rule()
    def crash(self) -> None:
        self.is_struck = True
        self.crash_actor(self.ref)

    @rule()
    def kill(self) -> None:
        self.is_struck = True
        self.kill_process(self.ref)


class PlainTravels(Travels):
    kind = "plain"


@pytest.mark.parametrize("machine", [Travels, CrashedTravels, PlainTravels])
def test_an_actor_that_travels_loses_doubles_and_reorders_nothing(machine: type[Travels]) -> None:
    quick = settings(
        max_examples=EXAMPLES,
        stateful_step_count=8,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
        phases=[Phase.generate, Phase.shrink],
    )
    run_state_machine_as_test(machine, settings=quick)
