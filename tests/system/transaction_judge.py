"""Who says whether what a machine for transactions sees may be."""

from __future__ import annotations

import asyncio
import dataclasses
import os
from collections.abc import Callable

import holdfast as hf
from holdfast.supervision.supervisor import Supervisor
from tests.system.transaction_actors import PER_ACTOR, PER_STATE, Look, Through
from tests.system.transaction_model import ROOT, Node, Spec, Step
from tests.system.transaction_plans import NAMES

LOOK_TIMEOUT = 2.0
LOOK_AGAIN = 0.05
"""Seconds between two looks at a tree in which something is still being restarted."""
SHOWN = 6
OWN = "/app/recovery"
"""Where the library's own actors live."""


@dataclasses.dataclass
class Ask:
    """An ask that is on its way."""

    who: int
    states: int
    """How often its state had been replaced then."""
    touched: int
    """How often it had been changed or struck then."""
    round: int
    """How often the dust had settled then."""


@dataclasses.dataclass
class Tab:
    """What is known of the count of one actor."""

    ones: int = 0
    states: int = 0
    unknown: int = 0
    """Asks since the last answer of which nobody knows whether they were handled."""
    touched: int = 0
    struck: int = -1
    """The round in which its life may have ended, and nobody has asked it since: -1 if there is none."""


class Judge:
    """Keeps what was acknowledged, and compares what is there with what should be."""

    def __init__(self, note: Callable[[str], None], *, checks_order: bool = True) -> None:
        self._note, self._checks_order = note, checks_order
        self.faults: list[str] = []
        self._tabs: dict[int, Tab] = {}
        self._round = 0
        self._struck: set[int] = set()
        """Who was crashed or killed since the dust settled last."""
        self._may_end: set[int] = set()
        """Whose lives may have ended since the dust settled last."""
        self._may_fail: set[int] = set()
        """Whose asks may fail."""

    def fault(self, text: str) -> None:
        """Something is not as promised."""
        self._note(f"FAULT {text}")
        self.faults.append(text)

    # -- what was acknowledged ----------------------------------------------------------------------------------------

    def _tab(self, who: int) -> Tab:
        return self._tabs.setdefault(who, Tab())

    def ask(self, who: int, spec: Spec) -> Ask:
        """Somebody asks an actor."""
        return Ask(who, spec.nodes[who].states, self._tab(who).touched, self._round)

    def failed(self, asked: Ask, error: Exception, spec: Spec) -> None:
        """The ask has failed."""
        tab = self._tab(asked.who)
        tab.unknown += 1
        is_excused = asked.who in self._may_fail or tab.touched != asked.touched or asked.who not in spec.nodes
        if not is_excused:
            self.fault(f"ask failed: {asked.who} ({spec.path(asked.who)}), which nothing has touched: {error!r}"[:300])

    def answered(self, asked: Ask, value: int, spec: Spec) -> None:
        """The ask was answered. Nobody else has asked this actor to add meanwhile."""
        if asked.who not in spec.nodes:
            return
        node, tab = spec.nodes[asked.who], self._tab(asked.who)
        ones, states = self._counted(node, tab, value, asked.states, adds=1)
        tab.ones, tab.states, tab.unknown = ones, states, 0
        if asked.round > tab.struck:
            tab.struck = -1

    def _counted(self, node: Node, tab: Tab, value: int, states_before: int, *, adds: int) -> tuple[int, int]:
        """Compare a count that was told with what was told before (`tab`); how many ones, and replaced states."""
        who, states, ones = value // PER_ACTOR, value % PER_ACTOR // PER_STATE, value % PER_STATE
        said = f"{node.who} has {ones} adds and {states} states, known were {tab.ones} (+ {tab.unknown} that may have "
        said += f"been) and {tab.states}; {states_before} to {node.states} are in force"
        is_afresh = tab.struck >= 0 and not node.is_recorded
        if who != node.who:
            self.fault(f"somebody else: {who} answers for {node.who}")
        elif states > node.states or (adds and ones > tab.ones + 2 * (adds + tab.unknown)):
            self.fault(f"more than was done: {said}")
        elif (ones < tab.ones + adds or states < max(states_before, tab.states)) and not is_afresh:
            self.fault(f"acknowledged work is lost: {said}")
        return ones, states

    # -- what happens -------------------------------------------------------------------------------------------------

    def struck(self, who: int, spec: Spec) -> None:
        """Somebody is crashed or killed: whoever may end with it may begin afresh."""
        self._struck.add(who)
        for one in spec.ended_with(who):
            self._ends(one)
            self._tab(one).touched += 1

    def _ends(self, who: int) -> None:
        self._may_end.add(who)
        self._may_fail.add(who)
        self._tab(who).struck = self._round

    def committed(self, steps: list[Step], before: Spec, after: Spec) -> None:
        """A transaction is committed: those that it touches are not held to what was before."""
        for step in steps:
            for who in step.args:
                if isinstance(who, int) and who in before.nodes:
                    for node in before.walk(who):
                        self._tab(node.who).touched += 1
                        if step.verb in ("stop", "start", "remove"):
                            self._ends(node.who)
                        elif step.verb == "isolation":
                            self._may_fail.add(node.who)
        for who in self._struck & set(after.nodes):
            for one in after.ended_with(who):
                self._ends(one)  # It may be dealt with only now, by those who look after it now.

    # -- what is there ------------------------------------------------------------------------------------------------

    async def settled(self, system: hf.ActorSystem, spec: Spec, seconds: float) -> None:
        """Compare the system with the specification in force, when what is being restarted is back."""
        loop = asyncio.get_running_loop()
        deadline = loop.time() + seconds
        while (found := await self.differences(system, spec)) and not self.faults and loop.time() < deadline:
            await asyncio.sleep(LOOK_AGAIN)
        for text in found[:SHOWN]:
            self.fault(text)
        if not found:
            await self._take_over(system, spec)
        self._may_end = {who for who in self._may_end if who in spec.nodes and spec.nodes[who].is_suspended}
        self._may_fail = set(self._may_end)
        self._struck &= self._may_end
        self._round += 1

    async def differences(self, system: hf.ActorSystem, spec: Spec) -> list[str]:
        """Where the system is not as specified."""
        found: list[str] = []
        there, wanted = {path for path in system.tree() if not path.startswith(OWN)}, set(spec.tree())
        found += [f"missing: nobody lives at {path}" for path in sorted(wanted - there)]
        found += [f"left over: somebody lives at {path}" for path in sorted(there - wanted)]
        if found:
            return found
        async with system.transaction(dry_run=True) as nothing:
            pass
        if nothing.difference:
            found.append(f"dry run: nothing to do makes a difference: {nothing.difference}")
        for node in spec.walk(ROOT):
            if spec.is_running(node.who) and node.who != ROOT:
                try:
                    look = self._supervisor if node.is_supervisor else self._actor
                    found += await look(system, spec, node)
                except hf.HoldfastError as error:
                    found.append(f"silent: {spec.path(node.who)}: {error!r}"[:200])
        found += self._names(system, spec)
        return found

    async def _supervisor(self, system: hf.ActorSystem, spec: Spec, node: Node) -> list[str]:
        path, found = spec.path(node.who), list[str]()
        children = await system.ref(path, hf.Supervisor).ask(hf.WhichChildren(), LOOK_TIMEOUT)
        told = [(info.id, info.state) for info in children]
        below = [spec.nodes[who] for who in node.below]
        wanted = [(one.name, "stopped" if one.is_stopped else "running") for one in below]
        if sorted(told) != sorted(wanted):
            found.append(f"children: of {path} are {told}, not {wanted}")
        elif told != wanted and node.kind != "dynamic" and self._checks_order:
            found.append(
                f"order: the children of {path} are {[name for name, _ in told]}, not {[n for n, _ in wanted]}"
            )
        cell = system._node.find(path)
        actor = cell.actor if cell is not None else None
        if not isinstance(actor, Supervisor):
            return [*found, f"between two lives: {path}"]
        flags = (actor._flags.strategy, actor._flags.intensity, actor._flags.period)
        if flags != (node.strategy, node.intensity, node.period):
            found.append(f"flags: of {path} are {flags}, not {(node.strategy, node.intensity, node.period)}")
        return found

    async def _actor(self, system: hf.ActorSystem, spec: Spec, node: Node) -> list[str]:
        path, found = spec.path(node.who), list[str]()
        ref = system.ref(path, hf.Actor)
        tab, status = dataclasses.replace(self._tab(node.who)), await system.get_status(ref, timeout=LOOK_TIMEOUT)
        state = status.state
        may_differ = node.who in self._may_end
        if state != ("suspended" if node.is_suspended else "running") and not (may_differ and state == "running"):
            return [f"state: {path} is {state}, and is suspended: {node.is_suspended}"]
        if (system.pid_of(ref) == os.getpid()) != (node.isolation == "task"):
            found.append(f"place: {path} does not live in a {node.isolation}")
        if state == "suspended":
            return found
        kind, count = await ref.ask(Look(), LOOK_TIMEOUT)
        if kind != node.kind:
            found.append(f"class: {path} is a {kind}, not a {node.kind}")
        self._counted(node, tab, count, tab.states, adds=0)
        bound = {node.peer, *([node.spec_peer] if may_differ else [])}
        if "peer" not in status.bindings:
            reached = None
        elif any(who is not None and spec.nodes[who].is_suspended for who in bound):
            return found  # It would not answer.
        else:
            count = await ref.ask(Through(), LOOK_TIMEOUT)
            reached = None if count < 0 else count // PER_ACTOR
        if reached not in bound:
            found.append(f"binding: {path} reaches {reached}, not {node.peer}")
        return found

    def _names(self, system: hf.ActorSystem, spec: Spec) -> list[str]:
        found: list[str] = []
        for name in NAMES:
            try:
                path: str | None = system.whereis(name).path
            except hf.errors.NoSuchActor:
                path = None
            holder = spec.holder(name)
            wanted = spec.path(holder.who) if holder is not None else None
            may_be_lost = holder is not None and holder.who in self._may_end
            if path != wanted and not (path is None and may_be_lost):
                found.append(f"name: {name!r} is {path}, not {wanted}")
        return found

    async def _take_over(self, system: hf.ActorSystem, spec: Spec) -> None:
        """What a crash may take with it is from here on as it is."""
        for node in spec.leaves():
            if node.who not in self._may_end or not spec.is_running(node.who):
                continue
            ref = system.ref(spec.path(node.who), hf.Actor)
            status = await system.get_status(ref)
            node.is_suspended = status.state == "suspended"
            node.names = {name for name in node.names if name in system._node.names}
            if status.bindings.get("peer") != (None if node.peer is None else spec.path(node.peer)):
                node.peer = node.spec_peer  # It cannot be seen otherwise who is meant if that one is suspended.
            if not node.is_suspended and not node.is_recorded:
                _, count = await ref.ask(Look())
                node.states = count % PER_ACTOR // PER_STATE
