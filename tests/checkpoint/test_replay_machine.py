"""Recovery against a naive model: wherever lives end, the state is that of a life that never ended."""

from __future__ import annotations

import asyncio
from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

import holdfast as hf


class Push(hf.Message[int]):
    n: int


class Boom(hf.Message):
    n: int


class Put(hf.Message[int]):
    """Put aside until the door is open."""

    n: int


class Door(hf.Message):
    is_open: bool


class Echo(hf.Message[int]):
    n: int
    to: hf.ActorRef[Any]


class Heard(hf.Message[int]):
    n: int


class Look(hf.Message[list[int]]): ...


class Ear(hf.Actor):
    def __init__(self) -> None:
        self.heard: list[int] = []

    @hf.on(Heard)
    def hear(self, message: Heard) -> int:
        self.heard.append(message.n)
        return len(self.heard)

    @hf.on(Look)
    def look(self, message: Look) -> list[int]:
        return self.heard


class Stack(hf.Actor):
    def __init__(self) -> None:
        self.items: list[int] = []
        self.is_open = False

    @hf.on(Push)
    def push(self, message: Push) -> int:
        self.items.append(message.n)
        return len(self.items)

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        self.items.append(message.n)
        raise RuntimeError("boom")

    @hf.on(Put)
    def put(self, message: Put) -> int:
        if not self.is_open:
            self.ctx.stash()
            return 0
        self.items.append(message.n)
        return len(self.items)

    @hf.on(Door)
    def door(self, message: Door) -> None:
        self.is_open = message.is_open
        if self.is_open:
            self.ctx.unstash()

    @hf.on(Echo)
    async def echo(self, message: Echo) -> int:
        message.to.tell(Heard(-message.n))
        self.items.append(await message.to.ask(Heard(message.n), timeout=60.0))
        return len(self.items)

    @hf.on(Look, readonly=True)
    def look(self, message: Look) -> list[int]:
        return self.items


class Recovery(RuleBasedStateMachine):
    """The model handles each message at once and forgets nothing; a failed one leaves no trace."""

    def __init__(self) -> None:
        super().__init__()
        self.runner = asyncio.Runner(debug=False)
        self.items: list[int] = []
        self.heard: list[int] = []
        self.aside: list[int] = []
        self.is_open = False
        self.system = hf.ActorSystem("m", log=False, intensity=1_000_000)
        self.runner.run(self.system.__aenter__())

    @initialize(interval=st.sampled_from([0.0005, 3600.0]))
    def begin(self, interval: float) -> None:
        self.runner.run(self.start(interval))

    async def start(self, interval: float) -> None:
        self.ear: hf.ActorRef[Ear] = await self.system.start(hf.child("ear", hf.start(Ear), recovery=hf.hybrid()))
        recovery = hf.hybrid(interval=interval)
        self.stack: hf.ActorRef[Stack] = await self.system.start(hf.child("x", hf.start(Stack), recovery=recovery))

    def tell(self, message: hf.Message[Any]) -> None:
        async def send() -> None:
            self.stack.tell(message)

        self.runner.run(send())

    @rule(n=st.integers(0, 9))
    def push(self, n: int) -> None:
        self.tell(Push(n))
        self.items.append(n)

    @rule(n=st.integers(0, 9))
    def boom(self, n: int) -> None:
        self.tell(Boom(n))

    @rule(n=st.integers(0, 9))
    def put(self, n: int) -> None:
        self.tell(Put(n))
        (self.items if self.is_open else self.aside).append(n)

    @rule(is_open=st.booleans())
    def door(self, is_open: bool) -> None:
        self.tell(Door(is_open))
        self.is_open = is_open
        if is_open:
            self.items += self.aside
            self.aside.clear()

    @rule(n=st.integers(1, 9))
    def echo(self, n: int) -> None:
        self.tell(Echo(n, self.ear))
        self.heard += [-n, n]
        self.items.append(len(self.heard))

    @rule(ear_too=st.booleans(), ticks=st.integers(0, 6))
    def kill(self, ear_too: bool, ticks: int) -> None:
        async def strike() -> None:
            for _ in range(ticks):  # A little later, perhaps in the middle of a turn or of a recovery.
                await asyncio.sleep(0)
            self.stack.kill()
            if ear_too:
                self.ear.kill()

        self.runner.run(strike())

    @precondition(lambda self: self.items)
    @rule()
    def wait_for_a_snapshot(self) -> None:
        async def wait() -> None:
            await self.stack.ask(Look(), timeout=60.0)
            await asyncio.sleep(0.001)

        self.runner.run(wait())

    @rule()
    def look(self) -> None:
        assert self.runner.run(self.ask(self.stack)) == self.items
        assert self.runner.run(self.ask(self.ear)) == self.heard

    async def ask(self, ref: hf.ActorRef[Any]) -> list[int]:
        return await ref.ask(Look(), timeout=60.0)

    @invariant()
    def accepted_is_accepted(self) -> None:
        assert self.system.dead_letters == 0

    def teardown(self) -> None:
        try:
            if hasattr(self, "stack"):
                self.look()
        finally:
            self.runner.run(self.system.__aexit__(None, None, None))
            self.runner.close()


TestRecovery = Recovery.TestCase
TestRecovery.settings = settings(max_examples=60, stateful_step_count=25, deadline=None)
