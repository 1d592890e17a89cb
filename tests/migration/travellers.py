"""An actor that carries all there is to carry, the places it can be sent to, and who judges its way."""

from __future__ import annotations

import asyncio
import itertools
from typing import Any

import holdfast as hf
from holdfast.testing import History, Model, linearizable


class Add(hf.Message[int]):
    n: int


class Later(hf.Message[int]):
    """Answered when somebody says `Give`."""


class Give(hf.Message[bool]):
    n: int


class Keep(hf.Message[int]):
    """Stashed until somebody says `Open`."""

    n: int


class Open(hf.Message[bool]): ...


class Remind(hf.Message[bool]):
    """Have a timer tell `Rung`."""

    seconds: float


class Rung(hf.Message): ...


class Seen(hf.Message[dict[str, Any]]): ...


class Tie(hf.Message[bool]):
    """Link, and watch."""

    other: hf.ActorRef[Any]


class Traveller(hf.Actor):
    """Counts what is added. Beside that it can stash, owe a reply, have a timer running, and be linked."""

    def __init__(self) -> None:
        self.total = 0
        self.added: list[int] = []
        self.rung = 0
        self.ends: list[str] = []
        self.is_open = False
        self.handle: hf.ReplyHandle[int] | None = None

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.total += message.n
        self.added.append(message.n)
        return self.total

    @hf.on(Later)
    def later(self, message: Later) -> Any:
        self.handle = self.ctx.reply_handle()
        return self.handle

    @hf.on(Give)
    def give(self, message: Give) -> bool:
        handle, self.handle = self.handle, None
        if handle is not None:
            handle.reply(message.n)
        return handle is not None

    @hf.on(Keep)
    def keep(self, message: Keep) -> int:
        if not self.is_open:
            self.ctx.stash()
            return 0
        self.added.append(message.n)
        return message.n

    @hf.on(Open)
    def open(self, message: Open) -> bool:
        self.is_open = True
        self.ctx.unstash()
        return True

    @hf.on(Remind)
    def remind(self, message: Remind) -> bool:
        self.ctx.tell_after(message.seconds, Rung())
        return True

    @hf.on(Rung)
    def ring(self, message: Rung) -> None:
        self.rung += 1

    @hf.on(Tie)
    def tie(self, message: Tie) -> bool:
        self.ctx.trap_exits = True
        self.ctx.link(message.other)
        return True

    def on_exit(self, source: hf.ActorRef[Any], reason: hf.ExitReason) -> None:
        self.ends.append(source.path)

    @hf.on(Seen)
    def seen(self, message: Seen) -> dict[str, Any]:
        return {"total": self.total, "added": self.added, "rung": self.rung, "ends": self.ends}


class Neighbour(hf.Actor):
    """Somebody to be linked with."""

    @hf.on(Open)
    def end(self, message: Open) -> bool:
        self.ctx.stop()
        return True


KINDS: dict[str, Any] = {
    "plain": None,
    "recorded": hf.hybrid(interval=3600.0),
    "checkpoint_only": hf.checkpoint_only(interval=3600.0),
}


BELOW = "a process, below its supervisor"
OWN_BELOW = "a process of its own, below a supervisor in another"


def tree(place: str, kind: str) -> hf.ChildSpec:
    """The supervisor `/app/here`, with the traveller `one` at that place below it; its mailbox is bounded."""
    where: dict[str, Any] = {"mailbox": hf.bounded(100_000)}
    if place in ("a process", OWN_BELOW):
        where["isolation"] = "process"
    if place == "replicas":
        where["mechanism"] = hf.ftm.PBR()
    if KINDS[kind] is not None:
        where["recovery"] = KINDS[kind]
    one = hf.child("one", hf.start(Traveller), **where)
    if place in (BELOW, OWN_BELOW):
        return hf.supervisor("here", children=[one], isolation="process", intensity=1000)
    if place == "a process, two deep":
        inner = hf.supervisor("inner", children=[one], intensity=1000)
        return hf.supervisor("here", children=[inner], isolation="process", intensity=1000)
    return hf.supervisor("here", children=[one], intensity=1000)


def path(place: str) -> str:
    """The address of the traveller."""
    return "/app/here/inner/one" if place == "a process, two deep" else "/app/here/one"


async def take(system: hf.ActorSystem, ref: hf.ActorRef[Any], step: str) -> None:
    """Take one step with the traveller."""
    match step:
        case "task" | "process":
            await system.set_isolation(ref, step, timeout=60.0)
        case "protect":
            async with system.transaction(timeout=60.0) as change:
                change.protect(ref, hf.ftm.PBR())
        case "unprotect":
            async with system.transaction(timeout=60.0) as change:
                change.protect(ref, None)
        case "move":
            async with system.transaction(timeout=60.0) as change:
                change.move(ref, "/app/here" if ref.path.startswith("/app/there/") else "/app/there")
        case _:
            raise AssertionError(step)


class Stream:
    """Asks one after another, and tells, until it is stopped; then judges what the traveller has seen.

    The traveller's own list is the one order of events: each sender's additions stand in it once and in the order in
    which they were sent, and the history must be linearizable in just this order.
    """

    def __init__(self, ref: hf.ActorRef[Any]) -> None:
        self._ref, self._stopping = ref, False
        self._history = History()
        self._answered = self.told = 0
        self._task = asyncio.create_task(self._send())

    async def _send(self) -> None:
        while not self._stopping:
            self._history.tell(self._ref, Add(TOLD + self.told))
            self.told += 1
            await self._history.ask(self._ref, Add(self._answered + 1), 120.0)
            self._answered += 1

    async def reached(self, more: int) -> None:
        """Wait for so many answers more."""
        wanted = self._answered + more
        while self._answered < wanted:
            if self._task.done():
                self._task.result()
            await asyncio.sleep(0)

    async def stop(self) -> None:
        self._stopping = True
        await self._task

    def judge(self, added: list[int]) -> None:
        """Each addition once, in the order of its sender; each answer the sum of what stands before it."""
        asked = [n for n in added if 0 < n < TOLD]
        assert asked == list(range(1, self._answered + 1))
        assert [n for n in added if n >= TOLD] == list(range(TOLD, TOLD + self.told))
        self._history.end(self._history.begin("the judge", Seen()), sum(added))
        linearizable(self._history, in_order_of(added)).verify()


def in_order_of(added: list[int]) -> Model[int]:
    """A traveller that adds just this, in this order. The state is how many of them it has added."""
    sums = [0, *itertools.accumulate(added)]

    def step(count: int, message: Add | Seen) -> tuple[int, int | None]:
        if isinstance(message, Seen):
            return count, sums[count]
        if added[count : count + 1] != [message.n]:
            return count, None  # It was not its turn.
        return count + 1, sums[count + 1]

    return Model(0, step)


TOLD = 1_000_000


class Luggage:
    """What the traveller has on it: something stashed, a promised reply, a timer, a link."""

    def __init__(self, system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> None:
        self._system, self._ref = system, ref

    async def pack(self) -> None:
        self._neighbour = await self._system.start(hf.child("neighbour", hf.start(Neighbour)))
        assert await self._ref.ask(Tie(self._neighbour))
        self._ref.tell(Keep(STASHED))
        self._reply = self._ref.ask(Later(), timeout=120.0)
        self._reply.add_done_callback(lambda done: done.cancelled() or done.exception())  # It may never be unpacked.
        assert await self._ref.ask(Remind(0.3))

    async def unpack(self) -> dict[str, Any]:
        """Use all of it; what the traveller has seen in the end."""
        ref = self._ref
        assert await ref.ask(Give(9))
        assert await self._reply == 9
        assert await ref.ask(Open())
        assert await self._neighbour.ask(Open())
        seen: dict[str, Any] = {}
        try:
            async with asyncio.timeout(60.0):
                while not (seen and seen["rung"] and seen["ends"] and STASHED in seen["added"]):
                    await asyncio.sleep(0.005)
                    seen = await ref.ask(Seen(), timeout=60.0)
        except TimeoutError:
            missing = {"stashed": STASHED in seen["added"], "rung": seen["rung"], "ends": seen["ends"]}
            raise AssertionError(f"something of its luggage is lost: {missing}") from None
        assert seen["rung"] == 1
        assert seen["ends"] == ["/app/neighbour"]
        assert seen["added"].count(STASHED) == 1
        return {**seen, "added": [n for n in seen["added"] if n != STASHED]}


STASHED = -7
