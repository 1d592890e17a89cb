"""The fault-injection campaign: mechanism x fault, what becomes of each single fault while requests flow.

A fault is armed (`injection`), requests go on until it has happened, and then until the group is whole again. What
clients then see decides: *masked*: nothing at all; *detected*: a typed error, or an alarm of the mechanism; *silent*:
something is lost, wrong or done twice, and nobody says so. A *false alarm* is one without a fault.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import os
import random
import signal
import tempfile
from collections.abc import AsyncGenerator, Callable, Generator, Sequence
from pathlib import Path
from typing import Any

import holdfast as hf
from holdfast.ftm import host
from holdfast.ftm.alarms import Diverged, Masked, ProtectionLost
from holdfast.ftm.detector import Detection
from holdfast.ftm.events import FailedOver, ReplicaLost, WrongSuspicion
from holdfast.ftm.group import Group, Look
from holdfast.ftm.mechanism import Mechanism
from tests.ftm.injection import Fault, Page, recipe, unwrap, wrap_root
from tests.ftm.workloads import CLIENTS, WORKLOADS, Bad

REQUEST = "REQUEST"
"""In place of the message that the workload's clients send most."""
GIVE_UP = 3.0
"""Seconds in which an armed fault is reached, or is not on the way of this mechanism."""
ALARMS = (FailedOver, WrongSuspicion, Diverged, Masked, ProtectionLost, ReplicaLost)
QUICK = Detection(interval=0.02, pause=0.3)


# -- faults -----------------------------------------------------------------------------------------------------------


def way(layers: Sequence[Mechanism]) -> list[tuple[str, str, bool]]:
    """The steps of a request through the one that leads (A44 to A53): slot, message, whether it may fail there."""
    names = [one.name for one in layers]
    steps = [("protocol", "Work", True)]
    for index, name in enumerate(names):
        if index:
            steps.append((f"{name}.protocol", "Work", True))
        steps.append((f"{name}.before", "Work", True))
    steps += [("proceed", "Work", True), ("server", REQUEST, False)]
    for name in reversed(names):
        steps += [(f"{name}.after", "Done", True)]
        if name != names[0]:
            steps.append((f"{name}.protocol", "Done", True))
    if "pbr" in names:
        steps.append(("state", "Capture", True))
    if "tr" in names:
        steps += [("state", "LastRun", True), ("state", "RunAgain", True)]
    steps.append(("protocol", "Done", True))
    return steps


def far(layers: Sequence[Mechanism]) -> list[tuple[str, str]]:
    """The steps on the other replica (A52 to A54)."""
    outer = layers[0].name
    found = {"pbr": [("pbr.after", "Letter"), ("state", "Apply")]}
    found["lfr"] = [("lfr.before", "Letter"), ("proceed", "Work"), ("lfr.after", "Letter")]
    return found.get(outer, [])


def at_each(action: str, layers: Sequence[Mechanism], *, bricks_only: bool = False) -> list[Fault]:
    faults = [
        Fault(action, slot, message, when, leads=True)
        for slot, message, is_brick in way(layers)
        if is_brick or not bricks_only
        for when in ("before", "after")
    ]
    faults += [Fault(action, *step, when, leads=False) for step in far(layers) for when in ("before", "after")]
    return faults


def between(action: str, layers: Sequence[Mechanism]) -> list[Fault]:
    faults = [Fault(action, slot, message, leads=True) for slot, message, is_brick in way(layers) if is_brick]
    return faults + [Fault(action, *step, leads=False) for step in far(layers)]


def of_joining(action: str) -> list[Fault]:
    return [
        Fault(action, "protocol", message, when, leads=False)
        for message in ("Follow", "Letter")
        for when in ("before", "after")
    ]


def of_root() -> list[Fault]:
    parts = [("proxy", "Flush"), ("proxy", "Done"), ("detector", "Beat"), ("failover", "Look"), ("join", "Look")]
    return [Fault("raise", *part, when) for part in parts for when in ("before", "after")]


KINDS: dict[str, Callable[[Sequence[Mechanism]], list[Fault]]] = {
    "nothing": lambda layers: [],
    "crash of a replica": lambda layers: at_each("crash", layers),
    "crash of a brick": lambda layers: at_each("raise", layers, bricks_only=True),
    "crash while joining": lambda layers: of_joining("crash") + of_joining("raise"),
    "crash of a root part": lambda layers: of_root(),
    "hang": lambda layers: at_each("hang", layers),
    "SIGSTOP": lambda layers: at_each("stop", layers),
    "SIGSTOP, wake-up": lambda layers: at_each("stop", layers),
    "message delayed": lambda layers: between("delay", layers),
    "message doubled": lambda layers: between("double", layers),
    "message reordered": lambda layers: between("reorder", layers),
    "message lost": lambda layers: between("lose", layers),
    "answer, transient": lambda layers: [Fault("answer", "server", REQUEST, "after")] * 6,
    "state, transient": lambda layers: [Fault("state", "server", REQUEST, "after")] * 6,
    "message, transient": lambda layers: [Fault("message", "proceed", "Work", leads=True)] * 6,
    "answer, permanent": lambda layers: [Fault("answer", "server", REQUEST, "after", permanent=True)],
}
CRASHES = frozenset(kind for kind in KINDS if kind.startswith(("crash", "hang", "SIGSTOP")))
LATE = frozenset({"message delayed", "message doubled", "message reordered"})


def claims(layers: Sequence[Mechanism], kind: str) -> bool:
    """Whether this composition says that it masks such a fault."""
    tolerates = frozenset[str]().union(*(one.tolerates for one in layers))
    if kind == "nothing" or kind in LATE or kind == "crash of a root part":
        return True
    if kind in CRASHES:
        return "crash" in tolerates
    if kind in ("answer, transient", "state, transient"):
        return "transient_value" in tolerates or "permanent_value" in tolerates
    return kind == "answer, permanent" and "permanent_value" in tolerates


def makes_sense(layers: Sequence[Mechanism], kind: str) -> bool:
    """One replica alone has no other to join, or to go on when it is gone."""
    return kind not in CRASHES or max(one.replicas for one in layers) > 1


# -- the campaign -----------------------------------------------------------------------------------------------------


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
    unreached: list[str] = dataclasses.field(default_factory=list)
    trouble: list[str] = dataclasses.field(default_factory=list)

    @property
    def is_kept(self) -> bool:
        """Whether what was claimed is so."""
        if not self.claimed:
            return True
        return self.masked == self.injected and not (self.lost or self.wrong or self.doubled or self.false_alarms)

    def __str__(self) -> str:
        claimed = "claimed" if self.claimed else "       "
        numbers = "".join(f"{n:9}" for n in (self.requests, self.injected, self.masked, self.detected, self.silent))
        ends = "".join(f"{n:8}" for n in (self.false_alarms, self.lost, self.wrong, self.doubled))
        return f"{self.mechanism:14} {self.workload:8} {self.kind:22} {claimed} {numbers}{ends}"


HEAD = (
    f"{'mechanism':14} {'load':8} {'fault':22} {'':7} {'requests':>9}{'injected':>9}{'masked':>9}{'detected':>9}"
    f"{'silent':>9}{'false':>8}{'lost':>8}{'wrong':>8}{'twice':>8}"
)


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
        saved, before = wrap_root(page), host.replica
        host.replica = recipe(page)
        try:
            with detecting(detection):
                yield page
        finally:
            host.replica = before
            unwrap(saved)


@contextlib.contextmanager
def detecting(detection: Detection) -> Generator[None, None, None]:
    """Groups that start in this block watch their replicas so."""
    known: Any = host
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
    found = ref._cell.host
    return found.group if isinstance(found, host.GroupHost) else None


async def whole(ref: hf.ActorRef[Any]) -> None:
    """Wait until the group is complete."""
    async with asyncio.timeout(60):
        while True:
            group = group_of(ref)
            if group is not None and group.primary is not None and all(map(group.is_well, group.names)):
                return
            await asyncio.sleep(0.002)


class Campaign:
    """One row: a system, a protected actor, clients, and one fault after the other."""

    def __init__(self, name: str, layers: Sequence[Mechanism], kind: str, workload: str, seed: str) -> None:
        self.layers, self.kind = tuple(layers), kind
        self.row = Row(name, workload, kind, claims(layers, kind))
        self.rng = random.Random(f"{seed} {name} {kind} {workload}")
        timeout = 30.0 if self.row.claimed else 1.0
        self.load = WORKLOADS[workload](timeout, self.rng)
        self.trials: list[Trial] = []

    async def run(self, requests: int, *, most: int = 1_000_000) -> Row:
        """So many requests, and at most so many faults."""
        row, load = self.row, self.load
        faults = KINDS[self.kind](self.layers)
        self.rng.shuffle(faults)
        with injecting() as page:
            async with running() as system:
                self.system, self.page, self.events = system, page, system.events()
                self.ref = await load.start(system, self.layers)
                await whole(self.ref)
                self.events.take()
                load.begin()
                least = min(most, len(faults))
                spread = max(8, requests // max(1, least))
                if not faults:
                    await load.reached(requests)
                    row.false_alarms += sum(isinstance(one, ALARMS) for one in self.events.take())
                count = 0
                while count < least or (faults and load.done < requests and count < most):
                    fault = faults[count % len(faults)]
                    count += 1
                    await self._trial(fault, max(4, spread // 3))
                    await load.reached(max(4, spread * 2 // 3))
                await load.stop()
                bad = await load.bad()
                self._judge(bad)
                self.events.close()
        return row

    async def _trial(self, fault: Fault, more: int) -> None:
        page, load, row = self.page, self.load, self.row
        if fault.message == REQUEST:
            fault = dataclasses.replace(fault, message=load.main)
        fault = dataclasses.replace(fault, nth=self.rng.randrange(1, 6) if "join" not in self.kind else 1)
        self.events.take()
        page.arm(fault)
        if self.kind == "crash while joining":
            await self._kill_backup()
        elif fault.slot in ("failover", "join"):
            group = group_of(self.ref)
            assert group is not None
            for _ in range(fault.nth):
                group.tell(fault.slot, group_look())
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
        row.injected += 1
        await self._follow_up(fault, trial, more)
        trial.last = load.sent
        trial.alarms = [type(one).__name__ for one in self.events.take() if isinstance(one, (Diverged, Masked))]
        self.trials.append(trial)

    async def _follow_up(self, fault: Fault, trial: Trial, more: int) -> None:
        load = self.load
        if self.kind == "SIGSTOP, wake-up":
            await asyncio.sleep(0.05)
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.page.pid, signal.SIGCONT)
        elif fault.action == "lose":
            await asyncio.sleep(0.3)
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.page.pid, signal.SIGKILL)  # It waits for ever.
        await load.reached(more)
        if fault.permanent:
            self.page.disarm()
        await whole(self.ref)

    async def _kill_backup(self) -> None:
        group = group_of(self.ref)
        assert group is not None
        name = next(one for one in group.names if one != group.primary)
        pid = self.system._workers.processes().get(f"{self.ref.path}/ftm/{name}")
        if pid is not None:
            os.kill(pid, signal.SIGKILL)

    def _judge(self, bad: Bad) -> None:
        row, load = self.row, self.load
        row.requests = load.sent
        row.lost, row.wrong, row.doubled = len(bad.lost), len(bad.wrong), len(bad.doubled)
        left = bad.all()
        for trial in self.trials:
            inside = {number for number in left if trial.first <= number <= trial.last}
            errors = [number for number in load.failed if trial.first <= number <= trial.last]
            left -= inside
            if errors or (inside and "Diverged" in trial.alarms):
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


def group_look() -> Any:
    return Look()


async def run_row(
    name: str, layers: Sequence[Mechanism], kind: str, workload: str = "counter", *, requests: int, most: int, seed: str
) -> Row:
    """One row of the table."""
    return await Campaign(name, layers, kind, workload, seed).run(requests, most=most)
