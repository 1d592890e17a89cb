"""A simulated robot, its faults, and the whole loop around it.

The devices hang on a simulated power board, and the nodes are actors that publish to each other. All else is real: the
observers that look at them, the diagnoser, the repairer, its planner, its actions, and the supervisors.
"""

import asyncio
import dataclasses
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import holdfast as hf
from holdfast.diagnosis import DIAGNOSIS, REPAIR, DiagnoserActor, observer, tree
from holdfast.diagnosis.board import TOPIC, BoardMeasured, Load, SimulatedBoard, SwitchChannel
from holdfast.diagnosis.engine import Diagnosis, State
from holdfast.diagnosis.model import Model, System
from holdfast.diagnosis.observers import Agreement, Channel, GeneralObserver, HardwareObserver, Manner, NodeObserver
from holdfast.diagnosis.repair import (
    ActionBegan,
    ActionEnded,
    AdviceScored,
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
    Stance,
    Undone,
    power_up,
    repairer,
    shutdown,
    start_node,
    stop_node,
)
from tests.diagnosis.robot import paper_robot

M = TypeVar("M", bound=hf.Message[Any])

POWER, START = 1.0, 0.5
"""Seconds that a device, and a node, takes until it is there."""
EFFECT = 3.0
"""Seconds in which it must be seen to be."""
NEVER = float("-inf")
DRAWN, IDLE = 1000, 10
"""Milliamperes of a device that works, and of one that does not yet."""
BOARD = "/t/board"
OBSERVERS = "/t/diagnosis/observers"
SILENT = ("/joy",)
"""Topics that nobody looks at."""


class World:
    """What is really so, and what nobody knows but for looking.

    Args:
        robot: its components.
        pace: seconds of everything that comes again and again, relative to what is usual.
        noise: share of a period by which a message comes early or late; one of fifty does not come at all. Then the
            observers look twice before they say anything else than before.
    """

    def __init__(self, robot: System, pace: float = 1.0, noise: float = 0.0) -> None:
        self.noise = noise
        self.robot, self.model = robot, Model(robot)
        parts = self.model.components.values()
        self.hardware = [one.name for one in parts if one.kind.value == "SH"]
        self.nodes = [one.name for one in parts if not one.kind.is_hardware]
        self.drives = {one.name: [h for h in one.on if h in self.hardware] for one in parts}
        self.beat, self.every = 0.2 * pace, 0.25 * pace
        self.window = (1.6 if noise else 0.8) * pace
        self.time_to_live = 2.0 * pace
        self.addresses = {name: f"{keeper_of(name)}/node" for name in self.nodes}
        self.channels = {name: number for number, name in enumerate(self.hardware)}
        loads = [Load(name, DRAWN, inrush=0.0) for name in self.hardware]
        self.board = SimulatedBoard(loads, defaults=range(len(loads)), clock=now)
        self.powered = dict.fromkeys(self.hardware, NEVER)  # since when it works, if it is on
        self.started = dict.fromkeys(self.nodes, NEVER)
        self.is_built = False
        self.running: set[str] = set()
        self.dead: set[str] = set()  # cannot be switched on, or cannot be started
        self.hung: set[str] = set()  # on or running, and of no use until it is switched off or stopped
        self.flaky: set[str] = set()  # its next start does not work

    @property
    def on(self) -> set[str]:
        """The devices that work."""
        return {h for h, channel in self.channels.items() if channel in self.board.on and self.powered[h] <= now()}

    def switch(self, h: str, on: bool) -> None:
        """Put a device on, or off."""
        channel = self.channels[h]
        was = channel in self.board.on
        self.board.stuck = {self.channels[name] for name in self.dead & {*self.hardware}}
        self.board.switch(channel, on)
        is_on = channel in self.board.on
        if is_on and not was:
            self.powered[h] = now() + POWER
        if not is_on:
            self.hung.discard(h)

    def measured(self) -> BoardMeasured:
        """What the board says: a device draws its current when it works."""
        working = self.on
        self.board.wrong = {
            channel: IDLE for h, channel in self.channels.items() if channel in self.board.on and h not in working
        }
        return BoardMeasured(now(), self.board.measure())

    def starts(self, n: str) -> None:
        """A node starts. Raises RuntimeError if it cannot."""
        if n in self.dead:
            raise RuntimeError("its program is missing")
        if n in self.flaky:
            self.flaky.discard(n)
            raise RuntimeError("it ended at once")
        self.running.add(n)
        self.started[n] = now()

    def ends(self, n: str) -> None:
        """A node ends, or is killed."""
        self.running.discard(n)
        self.hung.discard(n)

    def serves(self, name: str) -> bool:
        """Whether a component does what it is for."""
        if name in self.channels:
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

    # -- what can be done to it

    def power_up(self, **options: Any) -> RepairAction:
        """The action, for this robot."""
        return power_up(BOARD, self.channels, **({"effect_timeout": EFFECT, "is_dangerous": False} | options))

    def start_node(self, **options: Any) -> RepairAction:
        """The action, for this robot."""
        return start_node(self.addresses, **({"effect_timeout": EFFECT} | options))

    def actions(self) -> Repertoire:
        """The four of the paper."""
        off = shutdown(BOARD, self.channels, effect_timeout=EFFECT, is_dangerous=False)
        stop = stop_node(self.addresses, effect_timeout=EFFECT)
        return Repertoire([self.power_up(), off, self.start_node(), stop])

    # -- who looks at it

    def observers(self) -> Iterator[hf.ChildSpec]:
        """Those of the paper (D51)."""
        agreement = Agreement(2, 3) if self.noise else Agreement()
        manner = Manner(every=self.every, time_to_live=self.time_to_live, agreement=agreement)
        yield observer("nodes", hf.start(NodeObserver, self.addresses, manner=manner))
        devices = [Channel(name, channel, least=DRAWN // 2) for name, channel in self.channels.items()]
        yield observer("power", hf.start(HardwareObserver, *devices, manner=manner))
        for one in self.model.components.values():
            for topic in one.out:
                if topic not in SILENT:
                    rate = hf.start(GeneralObserver, topic, 1 / self.beat, window=self.window, manner=manner)
                    yield observer(watcher(topic), rate)


def now() -> float:
    """Seconds on the loop clock."""
    return asyncio.get_running_loop().time()


def keeper_of(node: str) -> str:
    """The address of its supervisor."""
    return f"/t/robot/{node}"


def watcher(topic: str) -> str:
    """The name of who looks at a topic."""
    return f"rate of {topic.strip('/')}"


class Beat(hf.Message):
    """It is time to do something."""


class Late(hf.Message):
    """It was time a moment ago."""


class Data(hf.Message):
    """What nodes publish."""

    topic: str


class Node(hf.Actor):
    """Publishes, now and then or whenever what it is made from comes, as long as it is of any use."""

    deterministic = False

    def __init__(self, world: World, name: str) -> None:
        self._world, self._name = world, name
        self._out = world.model.components[name].out

    async def on_start(self, restored: bool) -> None:
        if self._world.is_built:
            await asyncio.sleep(START)
        self._world.starts(self._name)
        for topic in {topic for inputs in self._out.values() for topic in inputs}:
            self.ctx.subscribe(topic)
        if not all(self._out.values()):
            self.ctx.every(self._world.beat, Beat())

    def on_stop(self, reason: hf.ExitReason) -> None:
        self._world.ends(self._name)

    @hf.on(Beat)
    async def _beat(self, message: Beat) -> None:
        noise, beat = self._world.noise, self._world.beat
        if not noise:
            await self._publish(lambda inputs: not inputs)
        elif self.ctx.random.random() > 1 / 50:
            self.ctx.tell_after(self.ctx.random.uniform(0, 2 * noise) * beat, Late())

    @hf.on(Late)
    async def _late(self, message: Late) -> None:
        await self._publish(lambda inputs: not inputs)

    @hf.on(Data)
    async def _take(self, message: Data) -> None:
        await self._publish(lambda inputs: message.topic in inputs)

    async def _publish(self, which: Callable[[tuple[str, ...]], bool]) -> None:
        if self._world.serves(self._name):
            for topic, inputs in self._out.items():
                if which(inputs):
                    await self.ctx.publish(topic, Data(topic))


class Devices(hf.Actor):
    """The power board, as `BoardActor` shows it."""

    deterministic = False

    def __init__(self, world: World) -> None:
        self._world = world

    def on_start(self, restored: bool) -> None:
        self.ctx.every(self._world.every, Beat())

    @hf.on(Beat)
    async def _measure(self, message: Beat) -> None:
        await self.ctx.publish(TOPIC, self._world.measured())

    @hf.on(SwitchChannel)
    def _switch(self, message: SwitchChannel) -> None:
        self._world.switch(self._world.hardware[message.channel], message.on)


class Secretary(hf.Actor):
    """Writes down what repair tells, and what is diagnosed."""

    deterministic = False

    def __init__(self, told: list[hf.Message[Any]], times: list[float], news: asyncio.Event) -> None:
        self._told, self._times, self._news = told, times, news

    def on_start(self, restored: bool) -> None:
        self.ctx.subscribe(REPAIR)
        self.ctx.subscribe(DIAGNOSIS)

    @hf.on(AdviceScored)
    @hf.on(Undone)
    @hf.on(RepairBegan)
    @hf.on(Planned)
    @hf.on(ActionBegan)
    @hf.on(ActionEnded)
    @hf.on(ApprovalWanted)
    @hf.on(Held)
    @hf.on(Repaired)
    @hf.on(GaveUp)
    @hf.on(Diagnosis)
    def _write(self, message: hf.Message[Any]) -> None:
        self._told.append(message)
        self._times.append(now())
        self._news.set()


@dataclasses.dataclass
class Scene:
    """A running robot under repair."""

    system: hf.ActorSystem
    world: World
    told: list[hf.Message[Any]]
    times: list[float]
    news: asyncio.Event

    @property
    def repairer(self) -> hf.ActorRef[Repairer]:
        """Whoever lives at its address now."""
        return self.system.ref("/t/diagnosis/repairer", Repairer)

    @property
    def diagnoser(self) -> hf.ActorRef[DiagnoserActor]:
        """Whoever lives at its address now."""
        return self.system.ref("/t/diagnosis/diagnoser", DiagnoserActor)

    def all(self, kind: type[M]) -> list[M]:
        """What was told of this kind."""
        return [one for one in self.told if isinstance(one, kind)]

    def time_of(self, message: hf.Message[Any]) -> float:
        """When it was told."""
        return next(when for one, when in zip(self.told, self.times, strict=True) if one is message)

    def done(self) -> list[str]:
        """The steps that were begun, in order."""
        return [str(one.step) for one in self.all(ActionBegan)]

    def planned(self) -> list[list[list[str]]]:
        """The stages of each plan."""
        return [[[str(step) for step in stage] for stage in plan.stages] for plan in self.all(Planned)]

    async def hear(self, kind: type[M], count: int = 1) -> M:
        """Wait for the `count`-th message of a kind."""
        async with asyncio.timeout(1000):
            while len(self.all(kind)) < count:
                await self.news.wait()
                self.news.clear()
        return self.all(kind)[count - 1]

    async def healthy(self) -> None:
        """Wait until the last diagnosis finds nothing bad."""
        async with asyncio.timeout(1000):
            while (found := self.all(Diagnosis)) == [] or found[-1].state is not State.HEALTHY:
                await self.news.wait()
                self.news.clear()

    async def rest(self, quiet: float = 8.0, most: float = 600.0) -> None:
        """Wait until repair is over and stays so; fails when it takes longer than `most` virtual seconds."""
        began = now()
        while now() - began < most:
            count = len(self.told)
            await asyncio.sleep(quiet)
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

    async def change(self, change: Callable[[World], object]) -> None:
        """Let something happen to the world."""
        change(self.world)
        await settle(self.system, self.world)

    async def blind(self, *names: str) -> None:
        """End observers for good; all of them, if none are named."""
        keeper = self.system.ref(OBSERVERS, hf.Supervisor)
        for name in names or [one.id for one in await keeper.ask(hf.WhichChildren())]:
            await keeper.ask(hf.TerminateChild(name))


async def settle(system: hf.ActorSystem, world: World) -> None:
    """Have the nodes run that are to, and no others: a supervisor lets those be that end so, and repair does not."""
    wanted = set(world.running)
    for name in world.nodes:
        keeper = system.ref(keeper_of(name), hf.Supervisor)
        is_up = [one.state for one in await keeper.ask(hf.WhichChildren())] == ["running"]
        if is_up and name not in wanted:
            await keeper.ask(hf.TerminateChild("node", parks=False))
        if not is_up and name in wanted:
            await keeper.ask(hf.RestartChild("node"))


async def scene(
    system: hf.ActorSystem,
    policy: Policy | None = None,
    *,
    robot: System | None = None,
    recent: float = 30.0,
    pace: float = 1.0,
    noise: float = 0.0,
    before: Callable[[World], object] = lambda world: None,
    stance: Stance = "on",
    actions: Callable[[World], Repertoire] = World.actions,
    addresses: dict[str, str] | None = None,
    base: tuple[str, ...] = (),
) -> Scene:
    """The robot, its observers, the diagnoser and the repairer.

    Args:
        before: what happens to the robot before anybody looks.
        recent: see `DiagnoserActor`; 0: it does not know what was repaired.
        addresses, base: see `Repairer`; where the arbiter and the exclusion take components to be.
    """
    world = World(robot or paper_robot(), pace, noise)
    # Each below a supervisor of its own: one would start them one after another.
    children = [hf.supervisor(n, children=[hf.child("node", hf.start(Node, world, n))]) for n in world.nodes]
    await system.start(hf.supervisor("robot", children=children))
    world.is_built = True
    await system.start(hf.child("board", hf.start(Devices, world)))
    before(world)
    await settle(system, world)
    told, times, news = list[hf.Message[Any]](), list[float](), asyncio.Event()
    system.spawn(hf.start(Secretary, told, times, news), name="secretary")
    rules = policy or Policy(verify=6.0, settle=1.0, cool_down=0.5)
    where = world.addresses | (addresses or {})
    mend = repairer(world.model, actions(world), rules, addresses=where, base=base, stance=stance)
    await system.start(tree(world.robot, world.observers(), recent=recent, repairer=mend))
    return Scene(system, world, told, times, news)
