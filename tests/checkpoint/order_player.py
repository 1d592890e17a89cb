"""A root for `test_order.py`, which reads its steps as JSON on its command line: python order_player.py STORE STEPS.

Senders number what they say, each for itself, and receivers keep in which order it has come.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import os
import signal
import sys
from typing import Any

import holdfast as hf

TOPIC = "/said"
GATE = "/app/gate"
IN_TIME = 60.0
SUPERVISORS = {"north": ("r0", "r1"), "south": ("r2",)}
RECEIVERS = {f"{name}": f"/app/{above}/{name}" for above, names in SUPERVISORS.items() for name in names}


class Said(hf.Message[int]):
    sender: str
    n: int


class Pass(hf.Message[int]):
    """As `Said`, by way of the gate."""

    sender: str
    n: int
    to: str


class Say(hf.Message[int]):
    to: str
    verb: str
    times: int


class Tick(hf.Message):
    to: str


class Sent(hf.Message[dict[str, list[int]]]): ...


class Got(hf.Message[dict[str, list[int]]]): ...


class Receiver(hf.Actor):
    def __init__(self) -> None:
        self.got: dict[str, list[int]] = {}

    @hf.subscribe(TOPIC)
    @hf.on(Said)
    def said(self, message: Said) -> int:
        self.got.setdefault(message.sender, []).append(message.n)
        return message.n

    @hf.on(Pass)
    def passed(self, message: Pass) -> int:
        self.got.setdefault(message.sender, []).append(message.n)
        return message.n

    @hf.on(Got, readonly=True)
    def read(self, message: Got) -> dict[str, list[int]]:
        return self.got


class Gate(hf.Actor):
    """Hands on what comes."""

    @hf.on(Pass)
    def hand_on(self, message: Pass) -> Any:
        self.ctx.forward(self.ctx.find(RECEIVERS[message.to], Receiver))


class Sender(hf.Actor):
    """`sent` has what must come, by receiver."""

    def __init__(self, name: str, n: int = 0) -> None:
        self.name, self.n = name, n
        self.refs: dict[str, hf.ActorRef[Receiver]] = {}
        self.sent: dict[str, list[int]] = {}
        self.streams: list[Any] = []  # timers

    @hf.on(Say)
    async def say(self, message: Say) -> int:
        if message.verb == "stream":
            self.streams.append(self.ctx.every(0.01, Tick(message.to)))
            return self.n
        if message.verb == "no stream":
            for timer in self.streams:
                timer.cancel()
            self.streams.clear()
            return self.n
        for _ in range(message.times):
            to = self._ref(message.to)
            if message.verb == "timer":
                self.ctx.tell_after(0.0, Tick(message.to))
                continue
            if message.verb.startswith("pass"):
                await self._pass(message)
                continue
            said = self._next(message.to, must_come=message.verb in ("tell", "send"))
            match message.verb:
                case "tell":
                    to.tell(said)
                case "send":
                    with contextlib.suppress(hf.ActorStopped):  # Who was stopped by order takes nothing.
                        await to.send(said)
                case "publish":
                    await self.ctx.publish(TOPIC, said)
                case _:
                    try:
                        await to.ask(said, timeout=0.2)
                    except hf.HoldfastError:
                        pass
        return self.n

    async def _pass(self, message: Say) -> None:
        """Say it to the gate; what is passed has an order of its own."""
        said = self._next(f"{message.to} by the gate", must_come=message.verb == "pass on")
        passed, gate = Pass(f"{self.name} by the gate", said.n, message.to), self.ctx.find(GATE, Gate)
        if message.verb == "pass on":
            gate.tell(passed)
            return
        with contextlib.suppress(hf.HoldfastError):
            await gate.ask(passed, timeout=0.2)

    @hf.on(Tick)
    def tick(self, message: Tick) -> None:
        to = self._ref(message.to)
        to.tell(self._next(message.to, must_come=True))

    @hf.on(Sent, readonly=True)
    def read(self, message: Sent) -> dict[str, list[int]]:
        return self.sent

    def _ref(self, name: str) -> hf.ActorRef[Receiver]:
        if name not in self.refs:
            self.refs[name] = self.ctx.find(RECEIVERS[name], Receiver)
        return self.refs[name]

    def _next(self, name: str, *, must_come: bool) -> Said:
        self.n += 1
        if must_come:
            self.sent.setdefault(name, []).append(self.n)
        return Said(self.name, self.n)


def sender(name: str, kind: str, n: int = 0) -> hf.ChildSpec:
    kinds: dict[str, dict[str, Any]] = {
        "process": {"isolation": "process"},
        "pbr": {"mechanism": hf.ftm.PBR()},
        "lfr": {"mechanism": hf.ftm.LFR()},
    }
    own = kinds.get(kind, {})
    start: Any = hf.start(Gate) if name == "gate" else hf.start(Sender, name, n)
    return hf.child(name, start, recovery=hf.hybrid(interval=0.1), **own)


def supervisor(name: str, kind: str) -> hf.ChildSpec:
    own: dict[str, Any] = {"isolation": "process"} if kind == "process" else {}
    own = {"mechanism": hf.ftm.PBR()} if kind == "pbr" else own
    children = [hf.child(one, hf.start(Receiver), recovery=hf.hybrid(interval=0.1), **own) for one in SUPERVISORS[name]]
    return hf.supervisor(name, children=children)


class Program:
    """What one program has started."""

    def __init__(self, system: hf.ActorSystem) -> None:
        self.system = system
        self.root = system.ref("/app", hf.Supervisor)

    def at(self, name: str) -> hf.ActorRef[Receiver]:
        """Where a receiver runs."""
        for above in SUPERVISORS:
            try:
                return self.system.ref(f"/app/{above}/{name}", Receiver)
            except (hf.ActorStopped, hf.errors.NoSuchActor):
                pass
        raise hf.errors.NoSuchActor(RECEIVERS[name])

    async def step(self, verb: str, *args: Any) -> None:
        """Carry out one of the steps."""
        system = self.system
        match verb:
            case "sender":
                await system.start(sender(*args))
            case "sender anew":
                await system.stop(system.ref(f"/app/{args[0]}", Sender))
                await system.start(sender(*args), fresh=True)
            case "supervisor":
                await system.start(supervisor(*args))
            case "say":
                name, to, how, times = args
                await system.ref(f"/app/{name}", Sender).ask(Say(to, how, times), timeout=IN_TIME)
            case "restart":
                await self.root.ask(hf.RestartChild(args[0], running=True), timeout=IN_TIME)
            case "end supervisor":
                await self.root.ask(hf.TerminateChild(args[0]), timeout=IN_TIME)
            case "begin supervisor":
                await self.root.ask(hf.RestartChild(args[0]), timeout=IN_TIME)
            case "stop":
                async with system.transaction(timeout=IN_TIME) as change:
                    change.stop(args[0])
            case "start":
                async with system.transaction(timeout=IN_TIME) as change:
                    change.start(*args)
            case "move":
                name, above = args
                ref = self.at(name)
                if ref.path != f"/app/{above}/{name}":  # A program that was killed may have done it.
                    async with system.transaction(timeout=IN_TIME) as change:
                        change.move(ref, f"/app/{above}")
            case "wait":
                await asyncio.sleep(args[0])
            case "kill soon":
                asyncio.get_running_loop().call_later(args[0], os.kill, os.getpid(), signal.SIGKILL)
            case "kill":
                os.kill(os.getpid(), signal.SIGKILL)
            case _:
                await self.tell_all(*args)

    async def tell_all(self, senders: list[str]) -> None:
        """Say one thing more to each receiver, and print what has been said and has come when that is there."""
        sent, last = dict[str, dict[str, list[int]]](), dict[tuple[str, str], int]()
        verbs = ["tell"]
        with contextlib.suppress(hf.errors.NoSuchActor):
            self.system.ref(GATE, Gate)
            verbs.append("pass on")
        for name in senders:
            ref = self.system.ref(f"/app/{name}", Sender)
            await ref.ask(Say("", "no stream", 0), timeout=IN_TIME)
            async with asyncio.timeout(IN_TIME):
                await asyncio.sleep(0.2)  # Timers that are due have come by then.
            for to, verb in itertools.product(RECEIVERS, verbs):
                who = name if verb == "tell" else f"{name} by the gate"
                last[who, to] = await ref.ask(Say(to, verb, 1), timeout=IN_TIME)
            sent[name] = await ref.ask(Sent(), timeout=IN_TIME)
        got = dict[str, dict[str, list[int]]]()
        for to in RECEIVERS:
            receiver = self.at(to)
            async with asyncio.timeout(IN_TIME):
                while True:
                    got[to] = await receiver.ask(Got(), timeout=IN_TIME)
                    if all(n in got[to].get(who, ()) for (who, at), n in last.items() if at == to):
                        break
                    await asyncio.sleep(0.01)
        sys.stdout.write(json.dumps([sent, got]))


async def main(store: str, steps: list[list[Any]]) -> None:
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False, intensity=1000) as system:
        program = Program(system)
        for verb, *args in steps:
            await program.step(verb, *args)


if __name__ == "__main__":
    hf.run(main(sys.argv[1], json.loads(sys.argv[2])))
