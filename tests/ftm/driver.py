"""A small home: feeds requests to replicas that live in this process, and takes their outcomes, once each."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Iterable
from typing import Any

import msgspec

import holdfast as hf
from holdfast.actors.kernel.message import message_name
from holdfast.checkpoint.protocol import (
    MESSAGE,
    OK,
    START,
    Answer,
    Feed,
    Go,
    Outcome,
    PipeDone,
    Released,
    SnapshotNow,
    TurnEnd,
    came,
)
from holdfast.ftm.bricks.brick_messages import Done, Follow, Inward, Lead, Outward, PartEnded, Request, Strayed, Work
from holdfast.ftm.bricks.replica_orders import Install, Join, ReplicaBeat, SetPeer, Setting
from holdfast.ftm.model.mechanism import Mechanism
from holdfast.ftm.replica.replica import Replica

ADDRESS = "/app/x"


class Proxy(hf.Actor):
    """Stands where the proxy stands: hands what comes to the driver."""

    def __init__(self, driver: Driver) -> None:
        self._driver = driver

    @hf.on(Done)
    def done(self, message: Done) -> Any:
        self._driver.take(message)
        for one in message.more:
            if isinstance(one, Strayed) and not self._driver.holds_strays:
                self.ctx.create_task(self._again(one.path.rpartition("/")[2]))

    async def _again(self, name: str) -> None:
        """As the joiner does."""
        with contextlib.suppress(hf.HoldfastError):
            await self._driver.join(name)

    @hf.on(Outward)
    def outward(self, message: Outward) -> None:
        self._driver.out(message)


class Detector(hf.Actor):
    """Counts heartbeats."""

    def __init__(self) -> None:
        self.beats: dict[str, int] = {}

    @hf.on(ReplicaBeat)
    def beat(self, message: ReplicaBeat) -> None:
        self.beats[message.name] = self.beats.get(message.name, 0) + 1


class Driver:
    """The home and the proxy of one protected actor."""

    def __init__(self, system: hf.ActorSystem, recipe: hf.Start[Any], layers: Iterable[Mechanism]) -> None:
        self.system, self.recipe, self.layers = system, recipe, tuple(layers)
        self.epoch, self.config, self.number, self.next_id = 0, 0, 0, 0
        self.primary = ""
        self.ends: dict[int, TurnEnd] = {}
        self.order: list[TurnEnd] = []
        self.stale = 0
        self.doubled: list[TurnEnd] = []
        self.more: list[Any] = []
        self.released: dict[tuple[int, int], Any] = {}
        self.feeds: dict[int, Feed] = {}
        self.kinds: dict[int, type[hf.Message[Any]]] = {}
        self.answers: dict[tuple[int, int], Answer] = {}  # of asks the actor makes; set by `outside`
        self.outside: Any = None  # answers an ask of the protected actor: Out -> Answer | None
        self.waiting: dict[int, asyncio.Future[TurnEnd]] = {}
        self.batches: dict[int, asyncio.Future[None]] = {}
        self.queue: list[Work] = []
        self.out_now: Work | None = None
        self.partial = -1
        self.holds_ended = self.holds_strays = False

    async def start(self, names: Iterable[str] = ("r1", "r2"), isolation: str = "task", **setting: Any) -> None:
        """Start proxy, detector and replicas below a supervisor."""
        method = hf.hybrid().data() if hasattr(hf.hybrid(), "data") else {}
        self.setting: dict[str, Any] = {"config": 0, "method": method, "bindings": {}, "beat": 0.0, **setting}
        children = [hf.child("proxy", hf.start(Proxy, self)), hf.child("detector", hf.start(Detector))]
        ftm = hf.supervisor("ftm", children=children, intensity=100)
        await self.system.start(hf.supervisor("x", children=[ftm], intensity=100))
        self.isolation = isolation
        for name in names:
            await self.add(name)

    async def add(self, name: str) -> None:
        """One more replica; nobody restarts it."""
        setting = Setting(name, *(self.setting[key] for key in ("config", "method", "bindings", "beat")))
        layers = tuple(one.describe() for one in self.layers)
        spec = hf.child(
            name,
            hf.start(Replica, setting, self.recipe, layers),
            restart="temporary",
            isolation=self.isolation,  # type: ignore[arg-type]
        )
        above = self.system.ref(f"{ADDRESS}/ftm", hf.Actor)
        await above.ask(hf.StartChild(spec), 60.0)

    def path(self, name: str) -> str:
        return f"{ADDRESS}/ftm/{name}"

    def protocol(self, name: str) -> hf.ActorRef[Any]:
        return self.system._node.cell_at(f"{self.path(name)}/protocol").ref

    def brick(self, name: str, brick: str) -> Any:
        """A brick that lives in this process."""
        return self.system._node.cell_at(f"{self.path(name)}/{brick}").actor

    def server(self, name: str) -> Any:
        """The protected actor of a replica in this process."""
        return self.brick(name, "server")

    def standing(self, name: str) -> Any:
        return self.brick(name, "protocol")._standing

    async def lead(self, name: str) -> int:
        """A new epoch, with this one as the primary."""
        self.epoch += 1
        self.primary = name
        known = max((end.turn for end in self.order), default=-1)
        return await self.protocol(name).ask(Lead(self.epoch, self.config, known=known))

    async def join(self, name: str) -> int:
        await self.protocol(name).ask(Follow(self.epoch, self.config))
        return await self.protocol(self.primary).ask(Join(self.epoch, self.path(name)))

    async def begin(self, *others: str) -> None:
        """The first lives: one that leads, and others that follow; then turn 0."""
        await self.lead("r1")
        for name in others:
            await self.join(name)
        start = Feed(self._id(), -1, START, "", b"", 1.0)
        self.feeds[start.id] = start
        self.queue.append(Work(self.epoch, self.config, self._batch(), [Request("", 0, start)], Go(False, 0)))
        self._send()
        await self.until(start.id)

    def _id(self) -> int:
        self.next_id += 1
        return self.next_id - 1

    def _batch(self) -> int:
        self.number += 1
        return self.number

    def feed(self, message: hf.Message[Any], *, is_ask: bool = True, deadline: float = 0.0) -> Feed:
        key = self._id()
        body = self.system._node.codec.encode(message, ADDRESS)
        name = message_name(type(message))
        feed = Feed(key, -1, MESSAGE, name, body, 1000.0 + key, None, is_ask, (), (), deadline)
        self.feeds[key], self.kinds[key] = feed, type(message)
        return feed

    def send(self, *messages: hf.Message[Any], **options: Any) -> list[int]:
        """One batch of requests; returns their numbers."""
        feeds = [self.feed(one, **options) for one in messages]
        requests = [Request("/app/client", 1, one) for one in feeds]
        self.queue.append(Work(self.epoch, self.config, self._batch(), requests))
        self._send()
        return [one.id for one in feeds]

    def _send(self) -> None:
        if self.out_now is None and self.queue:
            self.out_now = self.queue.pop(0)
            self.protocol(self.primary).tell(self.out_now)

    def again(self) -> None:
        """After a failover: everything that has no end yet goes to the new primary, what had begun first."""
        left = sorted(
            (one for one in self.feeds.values() if one.id not in self.ends), key=lambda f: f.id != self.partial
        )
        self.queue.clear()
        self.out_now = None
        go = Go(False, 0) if not any(isinstance(one, str) for one in self.more) and 0 not in self.ends else None
        requests = [Request("/app/client", 1, one) for one in left]
        if requests:
            self.queue.append(Work(self.epoch, self.config, self._batch(), requests, go, True))
            self._send()

    async def fail_over(self, name: str) -> None:
        """The primary is dead: another one leads."""
        await self.lead(name)
        self.again()

    def take(self, done: Done) -> None:
        if done.epoch != self.epoch:
            self.stale += 1
            return
        for end in done.ends:
            if end.id in self.ends and self.ends[end.id].status != "stashed":
                self.doubled.append(end)
                continue
            assert end.turn < 0 or not self.order or end.turn == self.order[-1].turn + 1, (end, self.order[-1:])
            self.ends[end.id] = end
            self.order.append(end)
            if self.partial == end.id:
                self.partial = -1
            for out in end.outs:
                self._take_out(end.turn, out)
            waiting = self.waiting.pop(end.id, None)
            if waiting is not None and end.status != "stashed":
                waiting.set_result(end)
            elif waiting is not None:
                self.waiting[end.id] = waiting
        self.more += done.more
        if done.wait and not self.holds_ended:
            self.protocol(self.primary).tell(PartEnded(self.epoch, done.part))
        if done.is_last and self.out_now is not None and done.number == self.out_now.number:
            self.out_now = None
            self._send()

    def out(self, outward: Outward) -> None:
        if outward.epoch != self.epoch:
            self.stale += 1
            return
        for record in outward.records:
            if isinstance(record, Released):
                assert record.turn == (self.order[-1].turn if self.order else -1) + 1, "it is not at the front"
                self.partial = record.id
                for out in record.outs:
                    self._take_out(record.turn, out)
            else:
                self.more.append(record)

    def _take_out(self, turn: int, out: Any) -> None:
        known = self.released.setdefault((turn, out.k), out)
        assert known.digest() == out.digest(), f"output {turn}.{out.k} is another one: {known} {out}"
        if out.verb in ("ask", "send") and self.outside is not None:
            if (turn, out.k) not in self.answers:
                answer = self.outside(out)
                if answer is None:
                    return
                self.answers[turn, out.k] = answer
            self.inward(Outcome(turn, out.k, came(self.answers[turn, out.k])))

    def inward(self, *records: Outcome | SnapshotNow) -> None:
        self.protocol(self.primary).tell(Inward(self.epoch, list(records)))

    async def until(self, key: int, seconds: float = 10.0) -> TurnEnd:
        """The end of a request's turn."""
        end = self.ends.get(key)
        if end is not None and end.status != "stashed":
            return end
        future = self.waiting.setdefault(key, asyncio.get_running_loop().create_future())
        async with asyncio.timeout(seconds):
            return await asyncio.shield(future)

    async def ask(self, message: hf.Message[Any]) -> Any:
        """Ask the protected actor, in a batch of its own."""
        (key,) = self.send(message)
        return await self.reply(key)

    async def reply(self, key: int) -> Any:
        end = await self.until(key)
        codec = self.system._node.codec
        if end.answer.kind == "reply":
            return codec.decode_reply(self.kinds[key], end.answer.body)
        raise codec.decode_error(end.answer.kind, end.answer.name, end.answer.body)

    async def stop_replica(self, name: str) -> None:
        """A replica's process is gone."""
        cell = self.system._node.cell_at(self.path(name))
        gone = cell.ended()
        cell.kill()
        await gone


__all__ = ["ADDRESS", "OK", "Answer", "Driver", "Install", "PipeDone", "SetPeer", "msgspec"]
