"""Soak: mechanisms come, change and go every 200 ms under full load, while replicas are killed."""

from __future__ import annotations

import asyncio
import dataclasses
import os
import random
import signal
from collections import Counter as Tally
from typing import Any

import holdfast as hf
from holdfast.ftm.bricks.brick_messages import Done
from holdfast.ftm.mechanisms.pbr import PBR, Checkpointing
from holdfast.ftm.sec.authority import CertificationAuthority
from tests.ftm.accounts import Counter
from tests.ftm.campaign import Stuck, described, group_of, running, whole
from tests.ftm.stacks import CA, STACKS
from tests.ftm.workloads import Bad, Counting

PAUSE = 0.2
REPLICATED = ("PBR", "LFR", "AD+PBR", "AD+LFR", "TMR", "PBR+TR", "LFR+TR", "SEC+PBR", "SEC+PBR+TR", "PBR+own")
"""What is attached, and changed to: at any moment one replica may be killed."""


class Renewed(Checkpointing):
    """New code for a brick, which does the same."""

    async def after(self, done: Done) -> Done | None:
        return await super().after(done)


@dataclasses.dataclass
class Found:
    """What a soak has come to."""

    bad: Bad
    requests: int
    failed: int
    kills: int
    done: Tally[str]
    refused: Tally[str]
    stuck: str = ""

    def __str__(self) -> str:
        return (
            f"{self.requests} requests, {self.kills} kills, {self.done.total()} changes {dict(self.done)}, "
            f"{self.refused.total()} rolled back {dict(self.refused)}; failed {self.failed}, "
            f"lost {len(self.bad.lost)}, "
            f"wrong {len(self.bad.wrong)}, twice {len(self.bad.doubled)}" + (f"; STUCK {self.stuck}" * bool(self.stuck))
        )


class Plain(Counting):
    """The counter, without a mechanism to begin with."""

    async def start(self, system: hf.ActorSystem, mechanism: Any) -> hf.ActorRef[Any]:
        self.ref = await system.start(hf.child("c", hf.start(Counter)))
        return self.ref


class Changes:
    """One random change after the other, that makes sense for what stands there."""

    def __init__(self, system: hf.ActorSystem, ref: hf.ActorRef[Any], rng: random.Random) -> None:
        self._system, self._ref, self._rng = system, ref, rng
        self.done, self.refused = Tally[str](), Tally[str]()
        self.why: list[str] = []

    def _choices(self) -> dict[str, Any]:
        ref, group, name = self._ref, group_of(self._ref), self._rng.choice(REPLICATED)
        stack = STACKS[name]("counter")
        if group is None:
            return {f"attach {name}": lambda change: change.protect(ref, stack)}
        found: Any = ref._cell.host.place
        names = [one.name for one in found.layers]
        choices: dict[str, Any] = {
            "detach": lambda change: change.protect(ref, None),
            "transition": lambda change: change.protect(ref, stack),
        }
        if "tr" in names:
            choices["detach a layer"] = lambda change: change.protect(ref, [one for one in names if one != "tr"])
        elif names in (["pbr"], ["lfr"], ["sec", "pbr"]):
            choices["compose"] = lambda change: change.protect(ref, [*names, hf.ftm.TR()])
            choices["transition of a layer"] = lambda change: change.protect(
                ref, [*names[:-1], hf.ftm.LFR() if "pbr" in names else PBR()]
            )
        if names in (["pbr"], ["lfr"]):
            choices["compose outside"] = lambda change: change.protect(ref, [hf.ftm.SEC(CA), *names])
        if "pbr" in names:
            new = {"mechanism": "pbr", "role": "primary"}
            choices["update"] = lambda change: change.update(ref, "after", Renewed, **new)
        return choices

    async def one(self) -> None:
        choices = self._choices()
        name = self._rng.choice(sorted(choices))
        try:
            async with self._system.transaction(timeout=20) as change:
                choices[name](change)
        except hf.HoldfastError as error:
            self.refused[name] += 1
            self.why.append(f"{name}: {error!r}"[:300])
        else:
            self.done[name] += 1


async def run(seconds: float, rng: random.Random, *, least: int = 0) -> Found:
    """Soak for so long, and for so many changes."""
    async with running() as system:
        await system.start(hf.child("ca", hf.start(CertificationAuthority)))
        load = Plain(30.0, rng)
        ref = await load.start(system, None)
        load.begin()
        changes, loop = Changes(system, ref, rng), asyncio.get_running_loop()
        end, kills, bad, stuck = loop.time() + seconds, 0, Bad(), ""
        over = asyncio.Event()

        async def kill() -> None:
            nonlocal kills
            while not over.is_set():
                await asyncio.sleep(rng.uniform(0.1, 0.8))
                group = group_of(ref)
                if group is None or not group.replicas.whole_since()[0]:
                    continue  # One at a time: two are more than these mechanisms mask.
                pid = system._workers.processes().get(f"{ref.path}/ftm/{rng.choice(group.membership.names)}")
                if pid is not None and len(group.membership.names) > 1:
                    kills += 1
                    os.kill(pid, signal.SIGKILL)

        killing = asyncio.create_task(kill())
        try:
            while loop.time() < end or (changes.done.total() < least and loop.time() < end + 60):
                began = loop.time()
                await changes.one()
                await asyncio.sleep(max(0.0, PAUSE - (loop.time() - began)))
            over.set()
            await killing
            await load.reached(20)
            if group_of(ref) is not None:
                await whole(ref)
            await load.stop()
            bad = await load.bad()
        except (Stuck, TimeoutError, hf.AskTimeout) as error:
            stuck = str(error) or described(group_of(ref))
        finally:
            over.set()
            load.abandon()
        if load.failed:
            bad.lost.extend(load.failed)
            changes.why.append(repr(next(iter(load.failed.values()))))
    for line in changes.why[:10]:
        print(f"#   {line}")
    return Found(bad, load.sent, len(load.failed), kills, changes.done, changes.refused, stuck)
