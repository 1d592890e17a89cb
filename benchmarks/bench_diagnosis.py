"""How long does it take to find all minimal diagnoses, and what does it cost the event loop?

Baseline: clingo alone, given the very same cone of influence as a text (`program`), which finds the same sets; whoever
would write the rules for clingo by hand does no less. The engine's own time contains the cone, the ranking and the
candidates. The systems are random data flows as large as stated (15 % devices, 15 % their drivers, 5 % other drivers,
the rest nodes that make a topic from one to three others), with three silent faults and 20 % of the topics observed.

The closed loop: from the fault to the observation that all is well, by fault, in a small system of real actors; and the
paper's robot (`examples/rescue_robot.py`), whose power-up took 30.2 s in the paper. Most of these seconds are the time
in which a topic has to be silent before anybody says so.
Command: python benchmarks/bench_diagnosis.py [--quick] [--only engine]
"""

from __future__ import annotations

import asyncio
import json
import random
import statistics
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import NamedTuple

import clingo
from harness import Run, main

import holdfast as hf
from holdfast import diagnosis
from holdfast.diagnosis.engine import Diagnoser, Diagnosis
from holdfast.diagnosis.engine.cone import Cone, cone_of
from holdfast.diagnosis.literals import Literal, ok, on, running
from holdfast.diagnosis.model import Kind, Model, System
from holdfast.diagnosis.observations import Observed
from holdfast.diagnosis.observers import GeneralObserver, Manner
from holdfast.diagnosis.repair import Policy, Repaired
from holdfast.supervision.admin import TerminateChild

sys.path.append(str(Path(__file__).parent.parent))
from tests.diagnosis.circuits import COMPARATOR  # pyright: ignore[reportMissingImports]  # found by the line above

OBSERVED = 0.2
FAULTS = 3
CASES = 5
LIMIT = 1000
"""Diagnoses that either finds at most; the engine's are the best of all, and clingo's are any."""

MINIMAL = ("--heuristic=Domain", "--enum-mode=domRec", "--dom-mod=5,16", "--warn=none", str(LIMIT))
TICK_SECONDS = 0.001


class Case(NamedTuple):
    """Observations, and what bare clingo is given for them."""

    observed: Observed
    program: str


def flow(size: int, seed: int) -> System:
    """A random system of `size` components."""
    random_ = random.Random(seed)
    system, topics = System(), list[str]()
    devices = size * 15 // 100
    for i in range(devices):
        system.hardware(f"h{i}")
        system.driver(f"d{i}", on=[f"h{i}"], out=[f"/d{i}"])
        topics.append(f"/d{i}")
    for i in range(size * 5 // 100):
        system.driver(f"s{i}", out=[f"/s{i}"])
        topics.append(f"/s{i}")
    for i in range(size - 2 * devices - size * 5 // 100):
        inputs = random_.sample(topics[-200:], min(len(topics), random_.randint(1, 3)))
        system.node(f"n{i}", out={f"/n{i}": inputs})
        topics.append(f"/n{i}")
    return system


def observe(model: Model, faulty: set[str], seed: int) -> Observed:
    """Everything runs and is on; of the topics a fifth is observed, as they are with these silent faults."""
    random_ = random.Random(seed)
    fine: dict[str, bool] = {}
    for component in model.components.values():  # each is declared after those it needs
        works = component.name not in faulty and faulty.isdisjoint(component.on)
        for topic, inputs in component.out.items():
            fine[topic] = works and all(fine[wanted] for wanted in inputs)
    seen = {topic: is_fine for topic, is_fine in fine.items() if random_.random() < OBSERVED}
    alive: list[Literal] = [
        on(name) if component.kind is Kind.SWITCHABLE else running(name) for name, component in model.components.items()
    ]
    return Observed.of([*alive, *(ok(topic) if is_fine else ~ok(topic) for topic, is_fine in seen.items())])


def cases(engine: Diagnoser, seed: int) -> list[Case]:
    """Cases in which at least as many topics fail as there are faults."""
    made: list[Case] = []
    random_ = random.Random(seed)
    names = sorted(engine.model.components)
    while len(made) < CASES:
        observed = observe(engine.model, set(random_.sample(names, FAULTS)), random_.randrange(2**32))
        if len(observed.negative) >= FAULTS:
            made.append(Case(observed, program(the_cone(engine, observed))))
    return made


def the_cone(engine: Diagnoser, observed: Observed) -> Cone:
    index = engine._index
    return cone_of(index, index.numbers(observed.positive), index.numbers(observed.negative))


def program(cone: Cone) -> str:
    """The cone as a text for clingo."""
    lines = ["#show ab/1."]
    lines += (f"ab({component})." for component in sorted(cone.faulty))
    for part in cone.parts:
        lines += (f"{{ab({component})}}." for component in part.components)
        for step in (*part.denials, *part.steps):
            body = ", ".join([*(f"not ab({n})" for n in step.needs), *(f"ok({atom})" for atom in step.body)])
            lines.append(f"{'' if step in part.denials else f'ok({step.head})'} :- {body}.")
    return "\n".join(lines)


def bare(text: str) -> set[frozenset[int]]:
    """All minimal diagnoses by clingo alone."""
    control = clingo.Control(list(MINIMAL))
    control.add("base", [], text)
    control.ground([("base", [])])
    found: set[frozenset[int]] = set()

    def take(model: clingo.Model) -> None:
        found.add(frozenset(symbol.arguments[0].number for symbol in model.symbols(shown=True)))

    control.solve(on_model=take)
    return found


def milliseconds(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return (time.perf_counter() - began) * 1e3


def robot() -> System:
    """The paper's running example."""
    system = System()
    system.hardware("ja", "hu", "la")
    system.hardware("js", "imu", switchable=False)
    system.driver("jn", on=["ja"], out=["/odom"])
    system.driver("hn", on=["hu"], out=["/scan"])
    system.driver("lan", on=["la"])
    system.driver("in", on=["imu"], out=["/imu_data"])
    system.driver("jyn", on=["js"], out=["/joy"])
    system.node("jtn", out={"/cmd_vel": ["/joy"]})
    system.node("hm", out={"/map": ["/scan"]})
    system.node("lac")
    system.node("rviz")
    system.related(("jn", "odom.yaw"), ("in", "imu.yaw"))
    return system


async def engine_example(run: Run) -> None:
    """The median over all pairs of silent faults of the paper's robot: nothing is remembered between them."""
    engine = Diagnoser(robot(), seconds=60.0)
    seen = [observe_example(engine.model, {a, b}) for a in engine.model.components for b in engine.model.components]
    times: list[float] = []
    for observed in seen * (1 if run.quick else 5):
        engine._parts.clear()
        times.append(milliseconds(lambda observed=observed: engine.diagnose_now(observed)))  # type: ignore[misc] # bound
    run.bound("example of the paper, all minimal diagnoses", statistics.median(times), unit="ms", target=1.0)


def observe_example(model: Model, faulty: set[str]) -> Observed:
    """All topics of the robot but `/joy`, and whether its two ways of knowing the heading agree."""
    fine: dict[str, bool] = {}
    for component in model.components.values():
        works = component.name not in faulty and faulty.isdisjoint(component.on)
        for topic, inputs in component.out.items():
            fine[topic] = works and all(fine[wanted] for wanted in inputs)
    literals = [ok(topic) if is_fine else ~ok(topic) for topic, is_fine in fine.items() if topic != "/joy"]
    agree = model.vocabulary.parse("matched(odom.yaw,imu.yaw)")
    return Observed.of([*literals, agree if fine["/odom"] and fine["/imu_data"] else ~agree])


async def engine_comparator(run: Run) -> None:
    """The median over all stuck gates of the circuit 74L85, each at an input at which it shows."""
    engine = Diagnoser(COMPARATOR.model(), limit=10_000, seconds=60.0)
    random_ = random.Random(run.seed)
    stuck = [{gate: is_high} for gate in COMPARATOR.gates for is_high in (False, True)]
    seen = [COMPARATOR.observed(random_.choice(COMPARATOR.cases(one))) for one in stuck]
    times: list[float] = []
    for observed in seen * (1 if run.quick else 3):
        engine._parts.clear()
        times.append(milliseconds(lambda observed=observed: engine.diagnose_now(observed)))  # type: ignore[misc] # bound
    run.bound("74L85 with a stuck gate, all minimal diagnoses", statistics.median(times), unit="ms", target=20.0)


async def engine_1000(run: Run) -> None:
    await _engine(run, 1000)


async def engine_5000(run: Run) -> None:
    await _engine(run, 5000)


async def _engine(run: Run, size: int) -> None:
    engine = Diagnoser(flow(size, run.seed), limit=LIMIT, seconds=60.0)
    made = cases(engine, run.seed)
    for case in made:
        check(engine, engine.diagnose_now(case.observed), bare(case.program))

    def ours() -> float:
        total = 0.0
        for case in made:
            engine._parts.clear()  # what is remembered would flatter
            total += milliseconds(lambda case=case: engine.diagnose_now(case.observed))  # type: ignore[misc] # bound
        return total / len(made)

    def limit() -> float:
        return sum(milliseconds(lambda case=case: bare(case.program)) for case in made) / len(made)  # type: ignore[misc] # bound

    job = f"{size:,} components, {OBSERVED:.0%} of topics observed, {FAULTS} faults"
    await run.compare(job, ours, limit, unit="ms", target=1 / 1.5)


def check(engine: Diagnoser, said: Diagnosis, expected: set[frozenset[int]]) -> None:
    """Both found the same, or both as many as they may."""
    number = engine._index.number
    found = {frozenset(number[name] for name in one.bad) for one in said.candidates}
    assert found == expected if said.is_complete else len(found) == len(expected) == LIMIT


async def engine_again(run: Run) -> None:
    """One more topic is observed: what need not be solved again is not. The limit here is the engine without memory."""
    engine = Diagnoser(flow(5000, run.seed), limit=LIMIT, seconds=60.0)
    made = cases(engine, run.seed)

    def again(*, is_remembering: bool) -> float:
        total = 0.0
        for case in made:
            engine._parts.clear()
            engine.diagnose_now(case.observed)
            if not is_remembering:
                engine._parts.clear()
            total += milliseconds(lambda case=case: engine.diagnose_now(case.observed))  # type: ignore[misc] # bound
        return total / len(made)

    job = "5,000 components, called again"
    await run.compare(
        job, lambda: again(is_remembering=True), lambda: again(is_remembering=False), unit="ms", target=1.0
    )


async def engine_lag(run: Run) -> None:
    """How late the loop's callbacks are while diagnoses of 5,000 components are made in a thread."""
    engine = Diagnoser(flow(5000, run.seed), limit=LIMIT, seconds=60.0)
    made = cases(engine, run.seed)
    late: list[float] = []
    for _ in range(run.n):
        for case in made:
            engine._parts.clear()
            work = asyncio.create_task(engine.diagnose(case.observed))
            while not work.done():
                slept = time.perf_counter()
                await asyncio.sleep(TICK_SECONDS)
                late.append(time.perf_counter() - slept - TICK_SECONDS)
            await work
    p99 = sorted(late)[int(len(late) * 0.99)] * 1e3
    run.bound("lag of the loop meanwhile, p99", p99, unit="ms", target=10.0)


# -- the closed loop ------------------------------------------------------------------------------------------------

RATE = 25.0
WINDOW = 0.5
"""Seconds over which rates are counted: a topic that is silent so long, nearly, is not ok."""
LONG = 30.0


class Tick(hf.Message): ...


class Price(hf.Message): ...


class Fail(hf.Message):
    """Be silent from now on; or never come to an end with this message."""

    hangs: bool = False


class Source(hf.Actor):
    """Publishes, until it fails."""

    deterministic = False
    topic = "/prices"

    def on_start(self, restored: bool) -> None:
        self._timer = self.ctx.every(1 / RATE, Tick())

    @hf.on(Tick)
    async def _tick(self, message: Tick) -> None:
        await self.ctx.publish(self.topic, Price())

    @hf.on(Fail)
    async def _fail(self, message: Fail) -> None:
        self._timer.cancel()
        if message.hangs:
            await asyncio.Event().wait()


class Relay(hf.Actor):
    """Makes its topic from that of the source."""

    @hf.subscribe("/prices")
    @hf.on(Price)
    async def _price(self, message: Price) -> None:
        await self.ctx.publish("/trades", message)


class Listener(hf.Actor):
    """Tells when something was repaired."""

    deterministic = False

    def __init__(self, repaired: Callable[[Repaired], None]) -> None:
        self._told = repaired

    @hf.subscribe(diagnosis.REPAIR)
    @hf.on(Repaired)
    def _repaired(self, message: Repaired) -> None:
        self._told(message)


async def loop_of_repair(run: Run) -> None:
    """From each fault to its repair; the cause is restarted, and the relay, which is silent too, is left alone."""
    model = System()
    model.node("source", out=["/prices"])
    model.node("relay", out={"/trades": ["/prices"]})
    addresses = {name: f"/app/desk/{name}" for name in ("source", "relay")}
    manner = Manner(every=0.05, time_to_live=1.0)
    rates = [
        diagnosis.observer(name, hf.start(GeneralObserver, f"/{name}", RATE, RATE - 1, window=WINDOW, manner=manner))
        for name in ("prices", "trades")
    ]
    desk = hf.supervisor(
        "desk",
        children=[hf.child("source", hf.start(Source), shutdown=0.2), hf.child("relay", hf.start(Relay))],
    )
    done: asyncio.Queue[Repaired] = asyncio.Queue()
    async with hf.ActorSystem("app", log=False) as system:
        keeper = await system.start(desk)
        system.spawn(hf.start(Listener, done.put_nowait))
        policy = Policy(settle=0.2, cool_down=0.05, attempts=1000, window=1.0)
        watching = await diagnosis.watch(
            system, model, rates, addresses=addresses, repair="on", policy=policy, manner=manner
        )

        async def well() -> None:
            while len((await watching.observed()).positive) < 4:
                await asyncio.sleep(0.05)

        async def seconds(fault: Callable[[], Awaitable[object]]) -> float:
            await well()
            began = time.perf_counter()
            await fault()
            async with asyncio.timeout(LONG):
                repaired = await done.get()
            assert [str(step) for step in repaired.actions] == ["restart_child(source)"], repaired
            return time.perf_counter() - began

        source = system.ref(addresses["source"], Source)
        faults: dict[str, Callable[[], Awaitable[object]]] = {
            "silent": lambda: source.send(Fail()),
            "hangs in a turn": lambda: source.send(Fail(hangs=True)),
            "stopped by hand": lambda: keeper.ask(TerminateChild("source", parks=False)),
        }
        for name, fault in faults.items():
            times = [await seconds(fault) for _ in range(1 if run.quick else 3)]
            run.bound(f"from the fault to its repair: {name}", statistics.median(times), unit="s", target=2.0)


async def loop_of_the_robot(run: Run) -> None:
    """The paper's two scenarios with real processes; the least of three, as the machine's own delays count here."""
    program = Path(__file__).parents[1] / "examples" / "rescue_robot.py"

    async def told(scenario: str) -> dict[str, float]:
        command = (sys.executable, str(program), scenario, "--json")
        process = await asyncio.create_subprocess_exec(*command, stdout=subprocess.PIPE)
        said, _ = await process.communicate()
        assert process.returncode == 0
        one: dict[str, float] = json.loads(said)[0]
        return one

    ups = [await told("power-up") for _ in range(1 if run.quick else 3)]
    beyond = min(one["beyond"] for one in ups)
    run.bound("power-up of the robot, beyond its devices' own start", beyond, unit="s", target=0.5)
    down = await told("shut-down")
    run.bound("the robot's base is switched off, until all is well", down["seconds"], unit="s", target=10.0)


if __name__ == "__main__":
    engines = [engine_example, engine_comparator, engine_1000, engine_5000, engine_again, engine_lag]
    main([*engines, loop_of_repair, loop_of_the_robot])
