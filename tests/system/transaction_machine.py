"""A machine that changes a running tree by transactions while clients ask, actors crash and callers give up.

Beside the system it keeps the specification in force (`transaction_model`): a transaction that is committed changes
it, one that is not leaves it alone. When the dust of a round has settled the two are compared. What a crash may have
taken with it (names, a suspension, the state of an actor that is not recorded) is taken over from what is found.

`python -m tests.system.transaction_machine SEED [HAZARD ...]` shrinks the plan of a seed that fails.
"""

from __future__ import annotations

import asyncio
import dataclasses
import random
import sys
import traceback
from collections.abc import Callable, Coroutine
from typing import Any, cast

import holdfast as hf
from holdfast.testing import VirtualClockLoop
from tests.system import transaction_actors as actors
from tests.system.transaction_judge import Judge
from tests.system.transaction_model import ROOT, Cannot, Node, Spec, Step
from tests.system.transaction_plans import (
    HAZARDS,
    VERBS,
    Draw,
    Pause,
    Plan,
    Round,
    Script,
    Strike,
    draw_plan,
    settle,
    shorter,
)
from tests.system.trees import Add, Boom

CLIENTS = 3
ASK_TIMEOUT = 20.0
"""Longer than any transaction holds an actor, so that one who waits this long waits for nothing."""
PAUSE = 0.08
"""Seconds in which a step of a transaction does nothing, so that something can happen in the middle."""
NAP = 0.15
"""Seconds of a long turn."""
OVERTIME = 35.0
"""Seconds beside its limit that a transaction may take: to let go of what it has, and to stop what was removed."""
END = 60.0
"""Seconds in which a system ends."""


class Found(AssertionError):
    """What the machine has found, with everything that led to it."""

    def __init__(self, faults: list[str], trace: list[str]) -> None:
        super().__init__("\n".join([*faults, "--- what happened:", *trace]))
        self.faults = faults

    @property
    def kind(self) -> str:
        """The sort of the first fault."""
        return self.faults[0].split(":")[0]


class Machine:
    """One system, its specification, and who asks it things."""

    def __init__(self, system: hf.ActorSystem, run: Run) -> None:
        self.system, self._rng = system, random.Random(run.seed)
        self._is_alone = "concurrency" not in run.hazards  # no other transaction is under way with one
        self.spec = Spec()
        self.trace: list[str] = []
        self.judge = Judge(self.note, checks_order=run.checks_order)
        self._last = 0
        self._number = 0
        self._busy: set[int] = set()
        self._may_be_refused = False
        self._is_over = False

    def note(self, line: str) -> None:
        """Write down what happens."""
        self.trace.append(f"{asyncio.get_running_loop().time():9.4f} {line}")

    def _fresh(self) -> int:
        self._last += 1
        return self._last

    # -- the tree -----------------------------------------------------------------------------------------------------

    async def plant(self, *, processes: bool, stops: bool) -> None:
        """Three supervisors and a dynamic one, with plain and recorded actors."""
        for name, children in (("base", "pq"), ("left", "abcr"), ("right", "desx"), ("pool", "fg")):
            top = Node(self._fresh(), name, ROOT, "dynamic" if name == "pool" else "supervisor")
            top.strategy = "one_for_all" if name == "right" else "one_for_one"
            self.spec.do(Step("add", (ROOT, top)))
            below = [self._child(top.who, one, processes=processes) for one in children]
            for node in below:
                self.spec.do(Step("add", (top.who, node)))
            specs = [actors.spec_of(node, self._path_or_none(node.spec_peer)) for node in below]
            if name == "pool":
                pool = await self.system.start(hf.dynamic(name, intensity=top.intensity, period=top.period))
                for spec in specs:
                    await pool.ask(hf.StartChild(spec))
            else:
                await self.system.start(
                    hf.supervisor(
                        name,
                        strategy=cast(Any, top.strategy),
                        intensity=top.intensity,
                        period=top.period,
                        children=specs,
                    )
                )
        self.spec.planned.clear()
        async with self.system.transaction() as change:
            change.bind("/app/right/d", "peer", "/app/left/a")
            change.register("first", "/app/left/a")
            if stops:
                change.stop("/app/right/e")
        whos = {node.name: node.who for node in self.spec.nodes.values()}
        steps = [("bind", (whos["d"], whos["a"])), ("register", ("first", whos["a"])), ("stop", (whos["e"],))]
        steps = steps if stops else steps[:2]
        self.spec = self.spec.apply([Step(verb, args) for verb, args in steps])

    def _child(self, above: int, name: str, *, processes: bool) -> Node:
        node = Node(self._fresh(), name, above, is_recorded=name in "rsq")
        if name == "x":
            node.spec_peer = next(one.who for one in self.spec.nodes.values() if one.name == "p")
        if processes and name in "cs":
            node.isolation = "process"
        return node

    def _path_or_none(self, who: int | None) -> str | None:
        return None if who is None else self.spec.path(who)

    # -- clients ------------------------------------------------------------------------------------------------------

    async def _client(self, rng: random.Random) -> None:
        while not self._is_over:
            await (asyncio.sleep(0) if rng.random() < 0.5 else asyncio.sleep(rng.uniform(0.0, 0.04)))
            able = [n for n in self.spec.leaves() if self.spec.is_running(n.who) and not n.is_suspended]
            node = rng.choice(able) if able else None
            if node is not None and node.who not in self._busy:
                self._busy.add(node.who)
                await self._ask(node.who)
                self._busy.discard(node.who)

    async def _ask(self, who: int) -> None:
        try:
            ref = self.system.ref(self.spec.path(who), hf.Actor)
        except hf.HoldfastError:
            return  # It is being restarted, or has just been added.
        asked = self.judge.ask(who, self.spec)
        try:
            value = await ref.ask(Add(1), ASK_TIMEOUT)
        except hf.HoldfastError as error:
            self.judge.failed(asked, error, self.spec)
        else:
            self.judge.answered(asked, value, self.spec)

    # -- transactions -------------------------------------------------------------------------------------------------

    async def _carry_out(self, script: Script) -> bool:
        """Carry out a transaction; whether it was committed."""
        self._number += 1
        number, steps, commits = self._number, list[Step](), list[int]()

        def committed() -> None:
            commits.append(number)
            self.note(f"  transaction {number} commits")
            try:
                after = self.spec.apply(steps)
            except Cannot as error:
                self.judge.fault(f"cannot be: transaction {number} is committed, although {error}")
                return
            self.judge.committed(steps, self.spec, after)
            self.spec = after

        loop = asyncio.get_running_loop()
        begun = loop.time()
        outcome, is_given_up = "committed", False
        try:
            async with self.system.transaction(timeout=script.timeout) as change:
                begun = loop.time()
                self._collect(change, script, steps)
                self._may_be_refused = twice(steps)
                change.step(actors.Act("the end", told=committed))
                self.note(f"transaction {number}: {'; '.join(map(self._in_words, steps))} ({script})")
        except hf.TransactionFailed as error:
            outcome, is_given_up = str(error), True
        except asyncio.CancelledError:
            outcome = "cancelled"
        self.note(f"transaction {number} is over: {outcome}")
        if is_given_up and commits:
            self.judge.fault(f"failed after its commit: transaction {number}: {outcome}")
        if outcome == "committed" and not commits:
            self.judge.fault(f"not committed: transaction {number} ends as if it were")
        if loop.time() - begun > script.timeout + OVERTIME:
            self.judge.fault(f"late: transaction {number} took {loop.time() - begun:g} s of {script.timeout:g}")
        return bool(commits)

    def _collect(self, change: hf.system.Change, script: Script, steps: list[Step]) -> None:
        draft = self.spec.copy()
        for draw in script.draws:
            if draw.verb in ("fail", "hang", "pause"):
                work = {"fail": actors.fail, "hang": actors.hang, "pause": pause}[draw.verb]
                change.step(actors.Act(draw.verb, cast(Callable[[], Any], work)))
                continue
            before = draft.copy()
            step = settle(draw, draft, self._fresh)
            if step is not None and self._fits(draft):
                collect(change, step, before, self._target(before, draw))
                steps.append(step)
            else:
                draft = before

    def _fits(self, draft: Spec) -> bool:
        """Whether the transaction could end here."""
        after = draft.copy()
        try:
            after.end()
        except Cannot:
            return False
        return after.starts_alone()

    def _target(self, draft: Spec, draw: Draw) -> Callable[[int], Any]:
        """How a step names an actor: by its address at that point, or by a ref.

        Beside another transaction it is a ref: that may give the address to somebody else.
        """
        is_named = draw.numbers[2] % 2 == 0 and self._is_alone

        def target(who: int) -> Any:
            path = draft.path(who)
            if not is_named and who in self.spec.nodes:
                try:
                    return self.system.ref(self.spec.path(who), hf.Actor)
                except hf.HoldfastError:
                    return path
            return path

        return target

    def _in_words(self, step: Step) -> str:
        said = [self._said(one) for one in step.args]
        return f"{step.verb} {' '.join(said)}"

    def _said(self, value: Any) -> str:
        if isinstance(value, Node):
            marks = [mark for mark, is_so in (("recorded", value.is_recorded), ("late", value.is_late)) if is_so]
            return f"{value.who}={value.name}({', '.join([value.kind, *marks])}, bound to {value.spec_peer})"
        if isinstance(value, int) and value in self.spec.nodes:
            return f"{value}={self.spec.path(value)}"
        return str(value)

    # -- rounds -------------------------------------------------------------------------------------------------------

    async def run(self, plan: Plan, *, end: float) -> None:
        """Carry out a plan. Raises Found."""
        seeds = [self._rng.random() for _ in range(CLIENTS)]
        clients = [asyncio.create_task(self._client(random.Random(seed))) for seed in seeds]
        try:
            for number, one in enumerate(plan):
                self.note(f"-- round {number}")
                await self._round(one, end=end)
                if self.judge.faults:
                    return
        finally:
            self._is_over = True
            _, left = await asyncio.wait(clients, timeout=ASK_TIMEOUT + 10)
            for task in left:
                task.cancel()
            if left:
                self.judge.fault("unanswered: an ask outlasted its time-out")

    async def _round(self, one: Round, *, end: float) -> None:
        about = [asyncio.create_task(self._strike(strike)) for strike in one.strikes]
        scripts = [asyncio.create_task(self._script(script)) for script in one.scripts]
        done = await asyncio.gather(*scripts)
        await asyncio.gather(*about)
        if one.is_calm and done != [True] and not self._may_be_refused:
            self.judge.fault("not carried out: nothing was in the way of the transaction")
        await self.judge.settled(self.system, self.spec, end)
        for number in one.restarts:
            if not self.judge.faults:
                await self._strike(Strike(("ticks", 0), "kill supervisor", number))
                await self.judge.settled(self.system, self.spec, end)

    async def _script(self, script: Script) -> bool:
        await wait(("ticks", script.begins_after))
        task = asyncio.create_task(self._carry_out(script))
        if script.cancelled_after is not None:
            await wait(script.cancelled_after)
            task.cancel()
        return await task

    async def _strike(self, strike: Strike) -> None:
        await wait(strike.after)
        spec = self.spec
        if strike.kind == "kill supervisor":
            able = [node for node in spec.supervisors() if spec.is_running(node.who) and node.kind != "dynamic"]
        else:
            able = [node for node in spec.leaves() if spec.is_running(node.who) and not node.is_suspended]
        if not able:
            return
        node = able[strike.number % len(able)]
        try:
            ref = self.system.ref(spec.path(node.who), hf.Actor)
        except hf.HoldfastError:
            return  # It is down already.
        self.note(f"  {strike.kind}: {node.who}={spec.path(node.who)}")
        if strike.kind == "nap":
            ref.tell(actors.Nap(NAP))
            return
        self.judge.struck(node.who, spec)
        if strike.kind == "boom":
            ref.tell(Boom())
        else:
            ref.kill()


def collect(change: hf.system.Change, step: Step, draft: Spec, target: Callable[[int], Any]) -> None:
    """Have the transaction do a step."""
    args = step.args
    match step.verb:
        case "add":
            above, node = args
            peer = None if node.spec_peer is None else draft.path(node.spec_peer)
            change.add(target(above), actors.spec_of(node, peer))
        case "move":
            change.move(target(args[0]), target(args[1]))
        case "start":
            node = draft.nodes[args[0]]
            change.start(target(node.above), node.name)
        case "stop":
            change.stop(target(args[0]))
        case "reorder":
            change.reorder(target(args[0]), [draft.nodes[one].name for one in args[1]])
        case "bind":
            change.bind(target(args[0]), "peer", target(args[1]))
        case "unbind":
            change.unbind(target(args[0]), "peer")
        case "register":
            change.register(args[0], target(args[1]))
        case "unregister":
            change.unregister(args[0])
        case "replace_state":
            change.replace_state(target(args[0]), actors.one_more)
        case "replace_code":
            change.replace_code(target(args[0]), actors.KINDS[args[1]])
        case verb:  # remove, strategy, intensity, isolation, suspend, resume
            getattr(change, verb)(target(args[0]), *args[1:])


def twice(steps: list[Step]) -> bool:
    """Whether a step is about somebody whom a step before it starts or stops: that may be refused."""
    seen: set[int] = set()
    for step in steps:
        if seen & {one for one in step.args if isinstance(one, int)}:
            return True
        if step.verb in ("start", "stop"):
            seen.add(step.args[0])
    return False


async def pause() -> None:
    await asyncio.sleep(PAUSE)


async def wait(how: Pause) -> None:
    """Come to a random instant: some ticks of the loop from now, or some seconds."""
    unit, amount = how
    if unit == "seconds":
        await asyncio.sleep(amount)
        return
    for _ in range(int(amount)):
        await asyncio.sleep(0)


# -- a run -------------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Run:
    """What is chosen for a run; the rest follows from the seed."""

    seed: int
    hazards: frozenset[str]
    rounds: int = 12
    verbs: tuple[str, ...] = VERBS
    processes: bool = False
    checks_order: bool = True

    def plan(self) -> Plan:
        """The plan of this seed."""
        rng = random.Random(f"{self.seed} {sorted(self.hazards)}")
        return draw_plan(rng, self.hazards, self.verbs, rounds=self.rounds)

    def __str__(self) -> str:
        return f"seed {self.seed}, hazards: {', '.join(sorted(self.hazards)) or 'none'}"


def where(error: BaseException) -> str:
    """The innermost places that an error comes from."""
    return "; ".join(
        f"{one.filename}:{one.lineno} {one.line}" for one in traceback.extract_tb(error.__traceback__)[-3:]
    )


async def carry_out(run: Run, plan: Plan, *, end: float = 15.0) -> None:
    """Carry out a plan in a new system. Raises Found: with what happened."""
    loop = asyncio.get_running_loop()
    faults, trace, leaving = list[str](), list[str](), 0.0
    try:
        async with hf.ActorSystem("app", log=False, intensity=1000, seed=run.seed) as system:
            machine = Machine(system, run)
            faults, trace = machine.judge.faults, machine.trace
            try:
                await machine.plant(processes=run.processes, stops="stop" in run.verbs)
                await machine.run(plan, end=end)
            except Exception as error:
                faults.append(f"raises: {error!r} at {where(error)}")
            leaving = loop.time()
    except hf.TreeFailed as error:
        faults.append(f"the tree failed: {error}")
        leaving = loop.time()
    if loop.time() - leaving > END:
        faults.append(f"slow end: it took {loop.time() - leaving:g} s")
    if faults:
        raise Found([f"{faults[0]} ({run})", *faults[1:]], trace)


async def limited(work: Coroutine[Any, Any, None], seconds: float = 3600.0) -> None:
    """Nothing hangs: a run comes to its end, by default within an hour of its clock."""
    async with asyncio.timeout(seconds):
        await work


def found_by(run: Run, plan: Plan) -> Found | None:
    """What a plan finds under the virtual clock; whatever ends the run is something found."""
    with asyncio.Runner(loop_factory=VirtualClockLoop) as runner:
        try:
            runner.run(limited(carry_out(run, plan)))
        except Found as found:
            return found
        except (TimeoutError, RuntimeError, hf.HoldfastError) as error:
            return Found([f"hangs: {error!r} ({run})"], [])
    return None


def shrunk(run: Run, plan: Plan, kind: str) -> tuple[Plan, Found]:
    """The shortest plan that still finds something of this kind, and what that is."""
    best = found_by(run, plan)
    assert best is not None
    again = True
    while again:
        again = False
        for less in shorter(plan):
            found = found_by(run, less)
            if found is not None and found.kind == kind:
                plan, best, again = less, found, True
                break
    return plan, best


def chosen(arguments: list[str]) -> Run:
    """A run by its words: a seed, hazards ("all" for all), "-stop" for no such steps, "-order" not to look at that."""
    words = frozenset(arguments[1:])
    left_out = {word[1:] for word in words if word.startswith("-")}
    hazards = frozenset(HAZARDS) if "all" in words else words - {f"-{verb}" for verb in left_out}
    unknown = (hazards - set(HAZARDS)) | (left_out - set(VERBS) - {"order"})
    if unknown:
        raise ValueError(f"what is {sorted(unknown)}? There are {HAZARDS}, and as verbs {sorted(set(VERBS))}")
    verbs = tuple(verb for verb in VERBS if verb not in left_out)
    return Run(int(arguments[0]), hazards, verbs=verbs, checks_order="order" not in left_out)


def main(arguments: list[str]) -> None:
    """Print what a run finds, with the shortest plan that finds it too."""
    run = chosen(arguments)
    found = found_by(run, run.plan())
    print(shrunk(run, run.plan(), found.kind)[1] if found is not None else f"{run}: nothing")


if __name__ == "__main__":
    main(sys.argv[1:])
