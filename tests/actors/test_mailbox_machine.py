"""One mailbox against a naive model: nothing accepted is lost or doubled, and order is kept (DESIGN 1, 4).

The model is a list of what is queued, a list of what is stashed, and a list of what was handled. The actor is free or
held at a gate in the middle of a turn, so that commands meet a full queue, an empty one, and a turn in hand.
"""

import asyncio
from collections.abc import Coroutine
from typing import Any, TypeVar

import uvloop
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

import holdfast as hf

T = TypeVar("T")


class Work(hf.Message[int]):
    """`what`: do it at once, or in two steps; put it aside; take all back; crash; be held until the gate opens."""

    n: int
    what: str


class Log:
    """What outlives the lives of the actor."""

    def __init__(self) -> None:
        self.handled: list[int] = []
        self.undelivered: list[int] = []
        self.gate = asyncio.Event()


class Worker(hf.Actor):
    def __init__(self, log: Log) -> None:
        self._log = log

    @hf.on(Work)
    async def work(self, message: Work) -> int:
        match message.what:
            case "stash" if message.n not in self._log.handled:
                self._log.handled.append(message.n)
                self.ctx.stash()
                return -1
            case "stash":  # back from the stash
                self._log.handled.append(message.n)
                return message.n
            case "hold":
                self._log.handled.append(message.n)
                await self._log.gate.wait()
                return message.n
            case "steps":
                await asyncio.sleep(0)
            case "unstash":
                self.ctx.unstash()
            case "crash":
                self._log.handled.append(message.n)
                raise ValueError(message.n)
        self._log.handled.append(message.n)
        return message.n

    def on_undelivered(self, message: hf.Message[Any]) -> None:
        assert isinstance(message, Work)
        self._log.undelivered.append(message.n)


class Mailbox(RuleBasedStateMachine):
    def __init__(self) -> None:
        super().__init__()
        self.next = 0
        self.queued: list[Work] = []
        self.stashed: list[Work] = []
        self.handled: list[int] = []
        self.lost: list[int] = []  # handed to on_undelivered
        self.asks: dict[int, asyncio.Future[int]] = {}
        self.expected: dict[int, type] = {}
        self.is_asked: set[int] = set()
        self.holding: int | None = None
        self.life = 1

    @initialize(fast=st.booleans())
    def begin(self, fast: bool) -> None:
        self.runner = asyncio.Runner(loop_factory=uvloop.new_event_loop if fast else asyncio.new_event_loop)
        self.run(self.enter())

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        return self.runner.run(work)

    async def enter(self) -> None:
        self.log = Log()
        self.system = await hf.ActorSystem("t", log=False, intensity=10**6).__aenter__()
        self.system._body = None  # each step of this machine runs in a task of its own
        await self.begin_again()

    async def begin_again(self) -> None:
        self.ref = await self.system.start(hf.child("worker", hf.start(Worker, self.log)))
        self.life = 1

    def teardown(self) -> None:
        if hasattr(self, "system"):
            self.run(self.leave())
            self.runner.close()

    async def leave(self) -> None:
        self.log.gate.set()
        await self.system.shutdown()
        for ask in self.asks.values():
            assert ask.done()
            ask.exception()

    # -- what the model says happens ---------------------------------------------------------------------------------

    def work_off(self) -> None:
        """Handle what is queued until it is empty or a turn is held."""
        while self.queued and self.holding is None:
            message = self.queued.pop(0)
            n = message.n
            outcome: type | None = int
            match message.what:
                case "stash" if n not in self.handled:
                    self.stashed.append(message)
                    outcome = None
                case "unstash":
                    self.queued[:0] = self.stashed
                    self.stashed.clear()
                case "hold":
                    self.holding, outcome = n, None
                case "crash":
                    self.end_life()
                    outcome = hf.RemoteCrash
            self.handled.append(n)
            if outcome is not None and n in self.is_asked:
                self.expected[n] = outcome

    def end_life(self) -> None:
        """The next life finds the stash before the queue."""
        self.queued[:0] = self.stashed
        self.stashed.clear()
        self.life += 1

    def admit(self, what: str, asked: bool) -> Work:
        message = Work(self.next, what)
        self.next += 1
        self.queued.append(message)
        if asked:
            self.is_asked.add(message.n)
        return message

    # -- rules -------------------------------------------------------------------------------------------------------

    @rule(
        whats=st.lists(st.sampled_from(["do", "do", "steps", "stash", "unstash", "crash", "hold"]), max_size=6),
        how=st.sampled_from(["tell", "send", "ask"]),
    )
    def put(self, whats: list[str], how: str) -> None:
        async def send() -> None:
            for what in whats:
                message = self.admit(what, how == "ask")
                match how:
                    case "tell":
                        self.ref.tell(message)
                    case "send":
                        await self.ref.send(message)
                    case "ask":
                        self.asks[message.n] = self.ref.ask(message, timeout=1000.0)

        self.run(send())
        self.work_off()

    @precondition(lambda self: self.holding is not None)
    @rule()
    def open_the_gate(self) -> None:
        self.log.gate.set()
        self.release()

    def release(self) -> None:
        """The held turn ends well; any that are queued pass an open gate one by one."""
        while self.holding is not None:
            if self.holding in self.is_asked:
                self.expected[self.holding] = int
            self.holding = None
            self.work_off()
        self.run(self.calm())
        self.log.gate.clear()

    @rule()
    def kill(self) -> None:
        """A turn in hand is over; so is the life; the rest waits for the next one."""
        self.run(self.calm())
        held, self.holding = self.holding, None
        if held in self.is_asked and held is not None:
            self.expected[held] = hf.AskFailed
        self.end_life()

        async def kill() -> None:
            ended = self.ref._cell.ended()
            self.ref.kill()
            await ended

        self.run(kill())
        self.work_off()

    @rule()
    def stop_for_good_and_start_again(self) -> None:
        """What is queued and stashed goes to `on_undelivered`, asks fail, and the address begins anew."""
        self.run(self.calm())

        async def stop() -> None:
            stopping = asyncio.create_task(self.system.stop(self.ref))
            cell = self.ref._cell
            while is_held and not cell.extra().urgent:  # until the command waits for the end of the turn
                await asyncio.sleep(0)
            self.log.gate.set()
            await stopping
            self.log.gate = asyncio.Event()
            await self.begin_again()

        is_held = self.holding is not None
        if self.holding is not None and self.holding in self.is_asked:
            self.expected[self.holding] = int
        self.holding = None
        for message in (*self.stashed, *self.queued):
            if message.n in self.is_asked:
                self.expected[message.n] = hf.ActorStopped
            else:
                self.lost.append(message.n)
        self.stashed.clear()
        self.queued.clear()
        self.run(stop())

    async def calm(self) -> None:
        """Nothing more happens; at most one turn is held at the gate."""
        node, held = self.system._node, int(self.holding is not None)
        for _ in range(10_000):
            await asyncio.sleep(0)
            if not node.awake and node.turns_held == held and (not held or self.log.handled == self.handled):
                return
        raise AssertionError(f"it does not come to rest: {self.ref._cell!r}, {self.log.handled} but {self.handled}")

    @invariant()
    def the_model_is_right(self) -> None:
        if not hasattr(self, "system"):
            return
        self.run(self.calm())
        assert self.log.handled == self.handled
        assert self.log.undelivered == self.lost
        assert {n: ask for n, ask in self.asks.items() if ask.done()}.keys() == self.expected.keys()
        for n, kind in self.expected.items():
            error = self.asks[n].exception()
            assert type(error) is kind if error is not None else (kind is int and self.asks[n].result() == n)
        assert self.ref._cell.life == self.life
        assert self.system.dead_letters == 0


TestMailbox = Mailbox.TestCase
TestMailbox.settings = settings(max_examples=60, stateful_step_count=25)
