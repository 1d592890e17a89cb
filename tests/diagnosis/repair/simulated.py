"""A simulated robot: devices, nodes, their observers and their faults; the repairer that is tested is the real one."""

import asyncio
import dataclasses
from collections.abc import Iterable

import holdfast as hf
from holdfast.diagnosis.engine import Diagnoser, Diagnosis, State
from holdfast.diagnosis.literals import Literal, ok, on, running
from holdfast.diagnosis.messages import DIAGNOSIS, OBSERVATIONS, REPAIR, GetDiagnosis, Touched
from holdfast.diagnosis.model import Model, System
from holdfast.diagnosis.observations import Observation, ObservationSet
from holdfast.diagnosis.planning import Step
from holdfast.diagnosis.repair import (
    Act,
    ActionBegan,
    ActionEnded,
    ActionFailed,
    ApprovalWanted,
    GaveUp,
    GetRepairStatus,
    Held,
    Planned,
    Policy,
    RepairAction,
    RepairBegan,
    Repaired,
    Repairer,
    Repertoire,
)
from tests.diagnosis.robot import paper_robot

PERIOD = 0.5
POWER, START, STOP = 1.0, 0.5, 0.2


class World:
    """What is really so."""

    def __init__(self, system: System) -> None:
        self.model = Model(system)
        parts = self.model.components.values()
        self.hardware = [one.name for one in parts if one.kind.value == "SH"]
        self.nodes = [one.name for one in parts if not one.kind.is_hardware]
        self.drives = {one.name: [h for h in one.on if h in self.hardware] for one in parts}
        now = asyncio.get_running_loop().time()
        self.on = set(self.hardware)
        self.powered = dict.fromkeys(self.hardware, now - 2)
        self.running = set(self.nodes)
        self.started = dict.fromkeys(self.nodes, now - 1)
        self.dead: set[str] = set()  # cannot be switched on, or cannot be started
        self.hung: set[str] = set()  # on or running, and of no use until it is switched off or stopped
        self.flaky: set[str] = set()  # its next start does not work
        self.mute = False
        self.unseen = {"/joy"}
        self.news = asyncio.Event()
        self.log: list[tuple[float, str]] = []

    def serves(self, name: str) -> bool:
        """Whether a component does what it is for."""
        if name in self.hardware:
            return name in self.on and name not in self.hung
        if name not in self.running or name in self.hung:
            return False
        # A driver loses its device when that loses its power; one that publishes nothing finds it again by itself.
        is_lasting = not self.model.components[name].out
        needed = self.drives.get(name, ())
        return all(self.serves(h) and (is_lasting or self.started[name] > self.powered[h]) for h in needed)

    def is_ok(self, topic: str) -> bool:
        """Whether a topic is as it should be."""
        for one in self.model.components.values():
            if topic in one.out:
                return self.serves(one.name) and all(map(self.is_ok, one.out[topic]))
        return True

    def is_healthy(self) -> bool:
        """Whether all of it works."""
        return all(self.serves(name) for name in (*self.hardware, *self.nodes))

    def seen(self) -> Iterable[Literal]:
        """What the observers say."""
        for h in self.hardware:
            yield on(h) if h in self.on else ~on(h)
        for n in self.nodes:
            yield running(n) if n in self.running else ~running(n)
        for one in self.model.components.values():
            for topic in one.out:
                if topic not in self.unseen:
                    yield ok(topic) if self.is_ok(topic) else ~ok(topic)

    # -- what can be done

    async def power_up(self, act: Act, h: str) -> None:
        await self._work(act, POWER)
        if h not in self.dead:
            self.on.add(h)
            self.powered[h] = asyncio.get_running_loop().time()
        self.news.set()

    async def shutdown(self, act: Act, h: str) -> None:
        await self._work(act, STOP)
        self.on.discard(h)
        self.hung.discard(h)
        self.news.set()

    async def start_node(self, act: Act, n: str) -> None:
        await self._work(act, START)
        if n in self.dead:
            raise ActionFailed(str(act.step), "its program is missing")
        if n in self.flaky:
            self.flaky.discard(n)
            raise ActionFailed(str(act.step), "it ended at once")
        self.running.add(n)
        self.started[n] = asyncio.get_running_loop().time()
        self.news.set()

    async def stop_node(self, act: Act, n: str) -> None:
        await self._work(act, STOP)
        self.running.discard(n)
        self.hung.discard(n)
        self.news.set()

    async def _work(self, act: Act, seconds: float) -> None:
        self.log.append((asyncio.get_running_loop().time(), str(act.step)))
        await asyncio.sleep(seconds)

    def actions(self) -> Repertoire:
        """The four of the paper."""
        runs = (self.power_up, self.shutdown, self.start_node, self.stop_node)
        return Repertoire(RepairAction(run.__name__, run, effect_timeout=3.0) for run in runs)


class Observe(hf.Message):
    """It is time to look."""


class Observers(hf.Actor):
    """All observers of the world: they look now and then, and when something changes."""

    deterministic = False

    def __init__(self, world: World) -> None:
        self._world = world

    def on_start(self, restored: bool) -> None:
        self.ctx.every(PERIOD, Observe())
        self.ctx.create_task(self._follow())
        self.ctx.tell_after(0, Observe())

    async def _follow(self) -> None:
        while True:
            await self._world.news.wait()
            self._world.news.clear()
            self.ctx.tell_after(0, Observe())

    @hf.on(Observe)
    async def _observe(self, message: Observe) -> None:
        now = asyncio.get_running_loop().time()
        for literal in () if self._world.mute else self._world.seen():
            await self.ctx.publish(OBSERVATIONS, Observation(literal, now, "eyes", 4 * PERIOD))


class Think(hf.Message):
    """It is time to diagnose."""


class Doctor(hf.Actor):
    """Diagnoses on change, the just repaired last."""

    deterministic = False

    def __init__(self, model: Model, ranks: bool) -> None:
        self._engine, self._set = Diagnoser(model), ObservationSet(model.vocabulary)
        self._ranks, self._touched = ranks, dict[str, float]()
        self._last: object = None
        self._due = False
        self._found = Diagnosis(State.BLIND)

    @hf.subscribe(OBSERVATIONS)
    @hf.on(Observation)
    def _see(self, message: Observation) -> None:
        if self._set.add(message) and not self._due:
            self._due = True
            self.ctx.tell_after(0.02, Think())

    @hf.subscribe(REPAIR)
    @hf.on(Touched)
    def _repaired(self, message: Touched) -> None:
        self._touched |= dict.fromkeys(message.components, message.time)

    @hf.on(GetDiagnosis)
    def _present(self, message: GetDiagnosis) -> Diagnosis:
        return self._found

    @hf.on(Think)
    async def _think(self, message: Think) -> None:
        self._due = False
        now = asyncio.get_running_loop().time()
        recent = [name for name, when in self._touched.items() if self._ranks and now - when < 30]
        found = await self._engine.diagnose(self._set.current(now), repaired=recent)
        self._found = found
        said = (found.state, found.candidates, found.symptoms)
        if said != self._last:
            self._last = said
            await self.ctx.publish(DIAGNOSIS, found)


class Secretary(hf.Actor):
    """Writes down what repair tells, and what is diagnosed."""

    deterministic = False

    def __init__(self, told: list[hf.Message], news: asyncio.Event) -> None:
        self._told, self._news = told, news

    def on_start(self, restored: bool) -> None:
        self.ctx.subscribe(REPAIR)
        self.ctx.subscribe(DIAGNOSIS)

    @hf.on(Touched)
    @hf.on(RepairBegan)
    @hf.on(Planned)
    @hf.on(ActionBegan)
    @hf.on(ActionEnded)
    @hf.on(ApprovalWanted)
    @hf.on(Held)
    @hf.on(Repaired)
    @hf.on(GaveUp)
    @hf.on(Diagnosis)
    def _write(self, message) -> None:
        self._told.append(message)
        self._news.set()


@dataclasses.dataclass
class Scene:
    """A running robot under repair."""

    system: hf.ActorSystem
    world: World
    repairer: hf.ActorRef[Repairer]
    told: list[hf.Message]
    news: asyncio.Event

    def all(self, kind):
        """What was told of this kind."""
        return [one for one in self.told if isinstance(one, kind)]

    def done(self) -> list[str]:
        """The steps that were begun, in order."""
        return [str(one.step) for one in self.all(ActionBegan)]

    def planned(self) -> list[list[list[str]]]:
        """The stages of each plan."""
        return [[[str(step) for step in stage] for stage in plan.stages] for plan in self.all(Planned)]

    async def hear(self, kind, count: int = 1):
        """Wait for the `count`-th message of a kind."""
        async with asyncio.timeout(1000):
            while len(self.all(kind)) < count:
                await self.news.wait()
                self.news.clear()
        return self.all(kind)[count - 1]

    async def rest(self, quiet: float = 8.0, most: float = 600.0) -> None:
        """Wait until repair is over and stays so; fails when it takes longer than `most` virtual seconds."""
        began = now = asyncio.get_running_loop().time()
        while now - began < most:
            count = len(self.told)
            await asyncio.sleep(quiet)
            now = asyncio.get_running_loop().time()
            status = await self.repairer.ask(GetRepairStatus())
            if not status.is_repairing and len(self.told) == count:
                return
        raise AssertionError(f"repair did not come to an end within {most} s: {self.told[-5:]}")

    def suspected(self) -> set[str]:
        """Whoever was blamed at any time."""
        return {name for one in self.all(Diagnosis) for name in one.suspects}

    def touched(self) -> set[str]:
        """Whoever was acted upon."""
        return {one.step.args[0] for one in self.all(ActionBegan)}

    def change(self, change) -> None:
        """Let something happen to the world."""
        change(self.world)
        self.world.news.set()


async def scene(
    system: hf.ActorSystem,
    policy: Policy | None = None,
    *,
    robot: System | None = None,
    ranks: bool = True,
    before=lambda world: None,
    actions=None,
    **options,
) -> Scene:
    """The robot, its observers, the diagnoser and the repairer."""
    world = World(robot or paper_robot())
    before(world)
    told, news = list[hf.Message](), asyncio.Event()
    system.spawn(hf.start(Secretary, told, news), name="secretary")
    system.spawn(hf.start(Doctor, world.model, ranks), name="doctor")
    rules = policy or Policy(verify=6.0, settle=1.0, cool_down=0.5)
    repertoire = actions(world) if actions is not None else world.actions()
    repairer = system.spawn(hf.start(Repairer, world.model, repertoire, rules, **options), name="repairer")
    system.spawn(hf.start(Observers, world), name="observers")
    return Scene(system, world, repairer, told, news)


def step(text: str) -> Step:
    """`start_node(jn)` as a step."""
    name, _, args = text.rstrip(")").partition("(")
    return Step(name, tuple(args.split(",")))
