"""The fault-injection campaign: mechanism x fault, what becomes of each single fault while requests flow.

A fault is armed (`injection`), requests go on until it has happened, and then until the group is whole again. What
clients then see decides: *masked*: nothing at all; *detected*: a typed error, or an alarm of the mechanism; *silent*:
something is lost, wrong or done twice, and nobody says so. A *false alarm* is one that no fault of this kind explains.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import os
import random
import signal
import tempfile
from collections.abc import AsyncGenerator, Generator, Sequence
from pathlib import Path
from typing import Any

import holdfast as hf
from holdfast.ftm.alarms import Diverged, Masked, Objected, Outvoted, ProtectionLost
from holdfast.ftm.bricks.sealed_frames import FrameRefused
from holdfast.ftm.events import FailedOver, ReplicaLost, WrongSuspicion
from holdfast.ftm.group import group_place
from holdfast.ftm.group.group import Group
from holdfast.ftm.group.membership import LookAgain
from holdfast.ftm.model.detection import Detection
from holdfast.ftm.model.mechanism import Mechanism
from tests.ftm.faults import FRAMES, KINDS, LATE, VALUES, claims
from tests.ftm.injection import READ, REQUEST, Fault, Page, recipe, unwrap, wrap_root
from tests.ftm.stacks import enrolling
from tests.ftm.workloads import CLIENTS, WORKLOADS, Bad

GIVE_UP = 3.0
"""Seconds in which an armed fault is reached, or is not on the way of this mechanism."""
STUCK = 60.0
"""Seconds after which nothing goes on any more."""
OF_VALUES = (Diverged, Masked, Objected, Outvoted)
OF_CRASHES = (FailedOver, WrongSuspicion, ProtectionLost, ReplicaLost)
TOLD = (Diverged, Objected, Outvoted, FrameRefused)
"""Alarms that say that something is wrong, though not that it was mended."""
QUICK = Detection(interval=0.02, pause=0.3)
WATCHED = dataclasses.replace(QUICK, watch_turns=1.0)


# -- the campaign -----------------------------------------------------------------------------------------------------


class Stuck(Exception):
    """Requests are not answered any more, or the group does not get whole again."""


@dataclasses.dataclass
class Row:
    """What became of the faults of one kind, under one mechanism."""

    mechanism: str
    workload: str
    kind: str
    claimed: bool
    requests: int = 0
    injected: int = 0
    masked: int = 0
    detected: int = 0
    silent: int = 0
    false_alarms: int = 0
    lost: int = 0
    wrong: int = 0
    doubled: int = 0
    failed: int = 0
    stuck: str = ""
    unreached: list[str] = dataclasses.field(default_factory=list)
    trouble: list[str] = dataclasses.field(default_factory=list)

    @property
    def is_kept(self) -> bool:
        """Whether what was claimed is so."""
        if not self.claimed:
            return True
        bad = self.lost or self.wrong or self.doubled or self.failed or self.false_alarms or self.stuck
        return self.masked == self.injected and not bad

    def __str__(self) -> str:
        claimed = "claimed" if self.claimed else "       "
        numbers = "".join(f"{n:9}" for n in (self.requests, self.injected, self.masked, self.detected, self.silent))
        ends = "".join(f"{n:8}" for n in (self.false_alarms, self.lost, self.wrong, self.doubled))
        return f"{self.mechanism:14} {self.workload:8} {self.kind:22} {claimed} {numbers}{ends}"


HEAD = (
    f"{'mechanism':14} {'load':8} {'fault':22} {'':7} {'requests':>9}{'injected':>9}{'masked':>9}{'detected':>9}"
    f"{'silent':>9}{'false':>8}{'lost':>8}{'wrong':>8}{'twice':>8}"
)


def table(rows: Sequence[Row]) -> str:
    """Mechanism x fault: of how many faults how many were masked, detected and silent; bold where it is claimed."""
    names = list(dict.fromkeys(row.mechanism for row in rows))
    kinds = [kind for kind in KINDS if any(row.kind == kind for row in rows)]
    lines = [[kind, *(cell(rows, name, kind) for name in names)] for kind in kinds]
    return "\n".join(f"| {' | '.join(line)} |" for line in [["fault", *names], ["---"] * (len(names) + 1), *lines])


def cell(rows: Sequence[Row], name: str, kind: str) -> str:
    """What stands in the table for one mechanism and one kind of fault, of all workloads."""
    here = [row for row in rows if (row.mechanism, row.kind) == (name, kind)]
    if not here:
        return "-"
    injected, masked = sum(row.injected for row in here), sum(row.masked for row in here)
    text = f"{masked} of {injected}" if kind != "nothing" else f"{sum(row.requests for row in here)} requests"
    for what in ("detected", "silent", "false_alarms"):
        count = sum(getattr(row, what) for row in here)
        text += f", {count} {what.replace('_', ' ')}" if count else ""
    text += ", stuck" if any(row.stuck for row in here) else ""
    return f"**{text}**" if here[0].claimed else text


@dataclasses.dataclass
class Trial:
    """One fault: the requests that were on their way from when it happened until all was well again."""

    fault: Fault
    first: int
    last: int = 0
    alarms: list[str] = dataclasses.field(default_factory=list)


@contextlib.contextmanager
def injecting(detection: Detection = QUICK) -> Generator[Page, None, None]:
    """Replicas that start in this block are struck by what is armed in the page."""
    with tempfile.TemporaryDirectory() as folder:
        page = Page.new(Path(folder) / "page")
        saved, before = wrap_root(page), group_place.replica
        group_place.replica = recipe(page)
        try:
            with detecting(detection):
                yield page
        finally:
            group_place.replica = before
            unwrap(saved)


@contextlib.contextmanager
def detecting(detection: Detection) -> Generator[None, None, None]:
    """Groups that start in this block watch their replicas so."""
    known: Any = group_place
    before, known.Detection = known.Detection, lambda: detection
    try:
        yield
    finally:
        known.Detection = before


@contextlib.asynccontextmanager
async def running() -> AsyncGenerator[hf.ActorSystem, None]:
    async with hf.ActorSystem("app", log=False, intensity=100_000) as system:
        yield system


def group_of(ref: hf.ActorRef[Any]) -> Group | None:
    found = ref._cell.host.place
    return found.group if isinstance(found, group_place.GroupPlace) else None


async def whole(ref: hf.ActorRef[Any]) -> None:
    """Wait until the group is complete.

    Raises:
        Stuck: it never is.
    """
    loop = asyncio.get_running_loop()
    end = loop.time() + STUCK
    while loop.time() < end:
        group = group_of(ref)
        if group is not None and group.replicas.whole_since()[0]:
            return
        await asyncio.sleep(0.002)
    raise Stuck(f"the group is not complete again: {described(group_of(ref))}")


def described(group: Group | None) -> str:
    """What is known of a group, for whoever wants to find out why it stands still."""
    if group is None:
        return "there is none"
    delivery = group.delivery
    out = delivery.out and (delivery.out.number, [one.feed.id for one in delivery.out.requests][:8])
    return f"{group.membership} out={out} waiting={len(delivery.waiting)} fed={list(delivery.fed)[:8]}"


class Campaign:
    """One row: a system, a protected actor, clients, and one fault after the other."""

    def __init__(self, name: str, layers: Sequence[Mechanism], kind: str, workload: str, seed: str) -> None:
        self.layers, self.kind = tuple(layers), kind
        self.row = Row(name, workload, kind, claims(layers, kind))
        self.rng = random.Random(f"{seed} {name} {kind} {workload}")
        self.load = WORKLOADS[workload](30.0 if self.row.claimed else 1.0, self.rng)
        self.trials: list[Trial] = []

    async def run(self, requests: int, *, most: int = 1_000_000) -> Row:
        """So many requests, and at most so many faults."""
        row, load = self.row, self.load
        faults = KINDS[self.kind](self.layers)
        self.rng.shuffle(faults)
        with injecting(WATCHED if self.kind.startswith("turn") else QUICK) as page:
            async with running() as system:
                self.system, self.page, self.events = system, page, system.events()
                await enrolling(system, self.layers)
                self.ref = await load.start(system, self.layers)
                await whole(self.ref)
                self.events.take()
                load.begin()
                try:
                    await self._strike(faults, requests, most)
                    await load.stop()
                    self._judge(await load.bad())
                except (Stuck, TimeoutError, hf.AskTimeout) as error:
                    row.stuck, row.requests = str(error) or described(group_of(self.ref)), load.sent
                    row.trouble.append(f"{row.stuck} after {self.trials[-1].fault if self.trials else 'nothing'}")
                finally:
                    load.abandon()
                    self.events.close()
        return row

    async def _strike(self, faults: list[Fault], requests: int, most: int) -> None:
        row, load = self.row, self.load
        least = min(most, len(faults))
        spread = max(8, requests // max(1, least))
        if not faults:
            await load.reached(requests)
            row.false_alarms += sum(isinstance(one, OF_VALUES + OF_CRASHES) for one in self.events.take())
        count = 0
        while count < least or (faults and load.done < requests and count < most):
            fault = faults[count % len(faults)]
            count += 1
            await self._trial(fault, max(4, spread // 3))
            await load.reached(max(4, spread * 2 // 3))
        if load.done < requests:
            await load.reached(requests - load.done)

    async def _trial(self, fault: Fault, more: int) -> None:
        page, load, row = self.page, self.load, self.row
        names = {REQUEST: load.main, READ: load.read or load.main}
        nth = self.rng.randrange(1, 6) if "join" not in self.kind else 1
        fault = dataclasses.replace(fault, message=names.get(fault.message, fault.message), nth=nth)
        self.events.take()
        page.arm(fault)
        if self.kind == "crash while joining":
            await self._kill_backup()
        elif fault.slot in ("failover", "join"):
            group = group_of(self.ref)
            assert group is not None
            for _ in range(fault.nth):
                group.replicas.tell(fault.slot, LookAgain())
                await load.reached(1)
        loop = asyncio.get_running_loop()
        end = loop.time() + GIVE_UP
        while not page.has_fired and loop.time() < end:
            await asyncio.sleep(0.0005)
        if not page.has_fired:
            page.disarm()
            row.unreached.append(str(fault))
            return
        trial = Trial(fault, max(0, load.sent - CLIENTS))
        self.trials.append(trial)
        row.injected += 1
        await self._follow_up(fault, more)
        trial.last = load.sent
        self._hear(trial)

    def _hear(self, trial: Trial) -> None:
        """What was told, and whether a fault of this kind explains it."""
        told = self.events.take()
        trial.alarms = [type(one).__name__ for one in told if isinstance(one, TOLD)]
        false: tuple[type[Any], ...] = () if self.kind in VALUES else OF_VALUES
        if self.kind in LATE | FRAMES:
            false += (FailedOver, ProtectionLost, ReplicaLost)  # A machine under load may well suspect for a moment.
        if self.kind in LATE and trial.fault.leads is False:
            false = ()  # A follower that gets something twice or in another order has really come to something else.
        if self.kind.startswith("turn"):
            false = ()  # A run that has no end is one that has come to something else.
        wrong = [one for one in told if isinstance(one, false)]
        self.row.false_alarms += len(wrong)
        self.row.trouble += [f"{trial.fault} nth={trial.fault.nth}: false alarm {one}" for one in wrong[:2]]

    async def _follow_up(self, fault: Fault, more: int) -> None:
        load = self.load
        if self.kind == "SIGSTOP, wake-up":
            await asyncio.sleep(self.rng.uniform(0.02, 0.45))  # About as long as it takes to be suspected.
            self._signal(signal.SIGCONT)
        elif fault.action == "wait":
            await self._ends(self.page.pid)  # It is a second or so before anybody knows.
        elif fault.action == "lose" and self.kind not in FRAMES:
            await asyncio.sleep(1.1 * load.timeout)
            self._signal(signal.SIGKILL)  # It waits for ever.
        await load.reached(more)
        if fault.permanent:
            self.page.disarm()
        await whole(self.ref)

    async def _ends(self, pid: int) -> None:
        async with asyncio.timeout(STUCK):
            while Path(f"/proc/{pid}").exists():
                await asyncio.sleep(0.01)

    def _signal(self, number: signal.Signals) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.page.pid, number)

    async def _kill_backup(self) -> None:
        group = group_of(self.ref)
        assert group is not None
        name = self.rng.choice([one for one in group.membership.names if one != group.membership.primary])
        pid = self.system._workers.processes().get(f"{self.ref.path}/ftm/{name}")
        if pid is not None:
            os.kill(pid, signal.SIGKILL)

    def _judge(self, bad: Bad) -> None:
        row, load = self.row, self.load
        row.requests, row.failed = load.sent, len(load.failed)
        row.lost, row.wrong, row.doubled = len(bad.lost), len(bad.wrong), len(bad.doubled)
        left = bad.all()
        for trial in self.trials:
            inside = {number for number in left if trial.first <= number <= trial.last}
            errors = [number for number in load.failed if trial.first <= number <= trial.last]
            left -= inside
            if errors or (inside and trial.alarms):
                row.detected += 1
            elif inside:
                row.silent += 1
            else:
                row.masked += 1
                continue
            if row.claimed:
                row.trouble.append(f"{trial.fault} nth={trial.fault.nth}: {sorted(inside)[:5]} {errors[:5]}")
                row.trouble += [repr(load.failed[number]) for number in errors[:2]]
        if left:
            row.trouble.append(f"outside of all trials: {sorted(left)[:5]}")


async def run_row(
    name: str, layers: Sequence[Mechanism], kind: str, workload: str = "counter", *, requests: int, most: int, seed: str
) -> Row:
    """One row of the table."""
    return await Campaign(name, layers, kind, workload, seed).run(requests, most=most)
