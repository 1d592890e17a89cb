"""Images against a naive model: random changes, random snapshots and crashes, and the state is always the same."""

from __future__ import annotations

import asyncio
from typing import Any

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

import holdfast as hf
from tests.checkpoint.image_player import Canvas, Digest, Paint, Write, digest_of

CELLS = 200_000


class Snapshots(RuleBasedStateMachine):
    """The model is the same class, in no system at all."""

    ref: hf.ActorRef[Canvas] | None = None

    def __init__(self) -> None:
        super().__init__()
        self.runner = asyncio.Runner(debug=False)
        self.system = hf.ActorSystem("m", log=False, intensity=1_000_000)
        self.runner.run(self.system.__aenter__())
        self.model: Any = Canvas.__new__(Canvas)
        Canvas.__init__(self.model, CELLS)

    @initialize(keep=st.sampled_from([1, 2]))
    def begin(self, keep: int) -> None:
        async def start() -> None:
            recovery = hf.hybrid(interval=3600.0, keep=keep)
            spec = hf.child("canvas", hf.start(Canvas, CELLS), recovery=recovery)
            self.ref = await self.system.start(spec)

        self.runner.run(start())

    def ask(self, message: hf.Message[Any]) -> Any:
        async def send() -> Any:
            assert self.ref is not None
            return await self.ref.ask(message, timeout=20.0)

        return self.runner.run(send())

    @rule(first=st.integers(0, CELLS), count=st.sampled_from([0, 1, 1000, CELLS // 3]), by=st.integers(-2, 2))
    def paint(self, first: int, count: int, by: int) -> None:
        message = Paint(first, count, by)
        assert self.ask(message) == self.model.paint(message)

    @rule(word=st.one_of(st.none(), st.text(max_size=5), st.just("long" * 30_000)))
    def write(self, word: str | None) -> None:
        message = Write(word)
        assert self.ask(message) == self.model.write(message)

    @rule()
    def snapshot(self) -> None:
        assert self.ref is not None
        self.runner.run(self.system.checkpoint(self.ref, timeout=20.0))

    @rule()
    def crash(self) -> None:
        async def strike() -> None:
            assert self.ref is not None
            self.ref.kill()
            await self.system._node.settled()

        self.runner.run(strike())

    @rule()
    def both(self) -> None:
        """A crash while a snapshot is wanted."""

        async def strike() -> None:
            assert self.ref is not None
            wish = asyncio.ensure_future(self.system.checkpoint(self.ref, timeout=20.0))
            await asyncio.sleep(0)
            self.ref.kill()
            await asyncio.wait([wish])
            wish.exception()

        self.runner.run(strike())

    @invariant()
    def is_the_same(self) -> None:
        if self.ref is not None:
            assert self.ask(Digest()) == digest_of(self.model)

    def teardown(self) -> None:
        self.runner.run(self.system.shutdown())
        self.runner.close()


TestSnapshots = Snapshots.TestCase
TestSnapshots.settings = settings(
    max_examples=15, stateful_step_count=12, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)


def test_the_model_and_the_actor_start_alike() -> None:
    model: Any = Canvas.__new__(Canvas)
    Canvas.__init__(model, 10)
    assert (model.grid == np.zeros(10)).all()
