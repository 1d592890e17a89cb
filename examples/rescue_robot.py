"""The rescue robot of Zaman et al. 2013 (figures 1 to 6): it is diagnosed and repaired while it runs.

Its nine nodes are actors in processes of their own. The devices are simulated; three of them hang on the channels of a
power board, over TCP: a simulated one, or with `--board` a real one. Observed is what the paper observes: the power of
the three, whether each node runs, and the rates of five topics.

    python examples/rescue_robot.py                          both scenarios as time lines
    python examples/rescue_robot.py shut-down --png .        draws it like the paper's figure, into a folder
    python examples/rescue_robot.py power-up --json          everything as data
"""

import argparse
import asyncio
import json
import sys
from pathlib import Path
from typing import Any, Final

import msgspec

import holdfast as hf
from holdfast.diagnosis import DIAGNOSIS, OBSERVATIONS, REPAIR, DiagnoserActor, GetDiagnosis, observer, repair, tree
from holdfast.diagnosis.board import TOPIC, Board, BoardActor, BoardMeasured, BoardSimulator, GetBoard
from holdfast.diagnosis.engine import Diagnosis, State
from holdfast.diagnosis.model import System
from holdfast.diagnosis.observations import Observation
from holdfast.diagnosis.observers import Agreement, Channel, GeneralObserver, HardwareObserver, Manner, NodeObserver
from holdfast.supervision.admin import TerminateChild

BOOT: Final = {"ja": 1.5, "hu": 1.0, "la": 0.5, "imu": 0.0, "js": 0.0}
"""Seconds from power to readiness of each device: what no repair can save."""
CHANNELS: Final = {"ja": 0, "la": 3, "hu": 5}
PC: Final = 1
"""The channel of the computer that all this runs on."""
RATE: Final = 25.0
"""Messages per second of each device, and so of each topic."""
OBSERVED: Final = ("/odom", "/map", "/scan", "/imu_data", "/cmd_vel")
GRACE: Final = 2.0
"""Seconds after a start of anything in which nobody says that something is bad."""
LONG: Final = 50.0
"""Seconds that nothing here takes, unless something is wrong."""


# -- the robot -------------------------------------------------------------------------------------------------------


class Connect(hf.Message[None]):
    """A driver connects; answered when the device is ready."""


class Data(hf.Message):
    """From a device to its drivers."""

    value: float


class Sample(hf.Message):
    """On the robot's topics."""

    value: float


class Tick(hf.Message): ...


class Ready(hf.Message):
    """The device has started: after the power-up of this number."""

    number: int


class Device(hf.Actor):
    """A simulated device. It takes its time to start, and when its power goes its drivers lose it.

    Args:
        channel: of the power board; None: it always has power.
        seconds: from power to readiness.
    """

    deterministic = False

    def __init__(self, channel: int | None, seconds: float) -> None:
        self._channel, self._seconds = channel, seconds
        self._has_power, self._is_ready, self._number, self._value = False, False, 0, 0.0
        self._drivers = set[hf.ActorRef[Any]]()
        self._waiting = list[tuple[hf.ActorRef[Any] | None, hf.ReplyHandle[None]]]()

    def on_start(self, restored: bool) -> None:
        self.ctx.every(1 / RATE, Tick())
        if self._channel is None:
            self._power(True)

    @hf.subscribe(TOPIC)
    @hf.on(BoardMeasured)
    def _measured(self, message: BoardMeasured) -> None:
        if self._channel is not None:
            self._power(message.measurements.channels[self._channel].on)

    def _power(self, is_on: bool) -> None:
        if is_on is self._has_power:
            return
        self._has_power, self._number = is_on, self._number + 1
        if is_on:
            self.ctx.tell_after(self._seconds, Ready(self._number))
        else:
            self._is_ready = False
            self._drivers.clear()

    @hf.on(Ready)
    def _ready(self, message: Ready) -> None:
        self._is_ready = message.number == self._number  # Else its power went meanwhile.
        self._serve()

    @hf.on(Connect)
    def _connect(self, message: Connect) -> hf.ReplyHandle[None]:
        handle: hf.ReplyHandle[None] = self.ctx.reply_handle()
        self._waiting.append((self.ctx.sender, handle))
        self._serve()
        return handle

    def _serve(self) -> None:
        while self._is_ready and self._waiting:
            driver, handle = self._waiting.pop()
            if driver is not None:
                self._drivers.add(driver)
            handle.reply(None)

    @hf.on(Tick)
    def _tick(self, message: Tick) -> None:
        self._value += 1 / RATE
        for driver in self._drivers:
            driver.tell(Data(self._value))


class Driver(hf.Actor):
    """Connects to its device when it starts, and never again: as drivers do."""

    deterministic = False

    def __init__(self, device: str, topic: str = "") -> None:
        self._device, self._topic = device, topic

    def on_start(self, restored: bool) -> None:
        self.ctx.create_task(self._connect())

    async def _connect(self) -> None:
        await self.ctx.find(f"/robot/devices/{self._device}", Device).ask(Connect(), LONG)

    @hf.on(Data)
    async def _data(self, message: Data) -> None:
        if self._topic:
            await self.ctx.publish(self._topic, Sample(message.value))


class Filter(hf.Actor):
    """Makes its topic from another one; without one of its own it only listens."""

    deterministic = False

    def __init__(self, source: str, topic: str = "") -> None:
        self._source, self._topic = source, topic

    def on_start(self, restored: bool) -> None:
        self.ctx.subscribe(self._source)

    @hf.on(Sample)
    async def _sample(self, message: Sample) -> None:
        if self._topic:
            await self.ctx.publish(self._topic, message)


NODES: Final[dict[str, hf.Start[Any]]] = {
    "jn": hf.start(Driver, "ja", "/odom"),
    "hn": hf.start(Driver, "hu", "/scan"),
    "lan": hf.start(Driver, "la"),
    "in": hf.start(Driver, "imu", "/imu_data"),
    "jyn": hf.start(Driver, "js", "/joy"),
    "jtn": hf.start(Filter, "/joy", "/cmd_vel"),
    "hm": hf.start(Filter, "/scan", "/map"),
    "lac": hf.start(Filter, "/imu_data"),
    "rviz": hf.start(Filter, "/map"),
}


def model() -> System:
    """The control graph of figure 2. Unlike the paper's, it says who drives `imu` and `js`: they can be to blame."""
    robot = System()
    robot.hardware("ja", "hu", "la")
    robot.hardware("js", "imu", switchable=False)
    robot.driver("jn", on=["ja"], out=["/odom"])
    robot.driver("hn", on=["hu"], out=["/scan"])
    robot.driver("lan", on=["la"])
    robot.driver("in", on=["imu"], out=["/imu_data"])
    robot.driver("jyn", on=["js"], out=["/joy"])
    robot.node("jtn", out={"/cmd_vel": ["/joy"]})
    robot.node("hm", out={"/map": ["/scan"]})
    robot.node("lac")
    robot.node("rviz")
    return robot


# -- who looks after it ----------------------------------------------------------------------------------------------


def care(url: str) -> hf.ChildSpec:
    """The board, the observers, the diagnoser and the repairer: all that keeps the robot alive."""
    addresses = {name: f"/robot/nodes/{name}" for name in NODES}
    # At first nothing bad is said, until the rates are known too: then all of it is said at once.
    manner = Manner(every=0.05, time_to_live=2.0, grace=GRACE)
    steady = msgspec.structs.replace(manner, agreement=Agreement(2, 3))
    rates = (hf.start(GeneralObserver, topic, RATE, RATE - 1, window=1.0, manner=steady) for topic in OBSERVED)
    observers = [
        observer("power", hf.start(HardwareObserver, *(Channel(*one) for one in CHANNELS.items()), manner=manner)),
        observer("nodes", hf.start(NodeObserver, addresses, manner=manner)),
        *(observer(f"rate of {topic[1:]}", rate) for topic, rate in zip(OBSERVED, rates, strict=True)),
    ]
    board = "/robot/diagnosis/board"
    # The robot switches its own power: nobody is there to approve it.
    policy = repair.Policy(settle=0.5, allow=frozenset({"power_up", "shutdown"}))
    actions = [
        repair.power_up(board, CHANNELS, grace=GRACE),
        repair.shutdown(board, CHANNELS),
        repair.start_node(addresses, grace=GRACE),
        repair.stop_node(addresses),
    ]
    return tree(
        model(),
        observers,
        others=[hf.child("board", hf.start(BoardActor, url, interval=0.02))],
        # Nothing is repaired before the whole robot is known.
        repairer=repair.repairer(model(), actions, policy, addresses=addresses, mode=repair.SAFE),
    )


# -- what happens, written down --------------------------------------------------------------------------------------


class Until(hf.Message[None]):
    """Answered when all of these literals are so, nothing else was diagnosed, and so many repairs are over."""

    literals: tuple[str, ...]
    state: State
    repairs: int = 0


class Line(msgspec.Struct):
    """Something that happened, in seconds on the loop clock."""

    time: float
    kind: str
    what: Any


class GetLines(hf.Message[list[Line]]): ...


class Recorder(hf.Actor):
    """Writes down what is observed, diagnosed and done."""

    deterministic = False

    def __init__(self) -> None:
        self._lines, self._said, self._repairs = list[Line](), dict[str, str](), 0
        self._state = State.BLIND
        self._waiting: tuple[Until, hf.ReplyHandle[None]] | None = None

    def _add(self, kind: str, what: Any, time: float | None = None) -> None:
        self._lines.append(Line(asyncio.get_running_loop().time() if time is None else time, kind, what))
        if self._waiting is not None:
            wanted, handle = self._waiting
            is_so = self._state is wanted.state and set(wanted.literals) <= set(self._said.values())
            if is_so and self._repairs >= wanted.repairs:
                self._waiting = None
                handle.reply(None)

    @hf.subscribe(OBSERVATIONS)
    @hf.on(Observation)
    def _observed(self, message: Observation) -> None:
        atom, literal = str(message.literal.atom), str(message.literal)
        if not message.time_to_live:  # It is taken back.
            if self._said.pop(atom, None):
                self._add("unknown", atom, message.time)
        elif self._said.get(atom) != literal:
            self._said[atom] = literal
            self._add("observed", literal, message.time)

    @hf.subscribe(DIAGNOSIS)
    @hf.on(Diagnosis)
    def _diagnosed(self, message: Diagnosis) -> None:
        self._state = message.state
        self._add("diagnosed", message.sets())

    @hf.subscribe(REPAIR)
    @hf.on(repair.Planned)
    @hf.on(repair.ActionBegan)
    @hf.on(repair.ActionEnded)
    @hf.on(repair.Repaired)
    @hf.on(repair.GaveUp)
    def _repairs_it(self, message: hf.Message) -> None:
        match message:
            case repair.Planned():
                self._add("planned", [[str(step) for step in stage] for stage in message.stages])
            case repair.ActionBegan():
                self._add("began", str(message.step), message.time)
            case repair.ActionEnded():
                self._add(message.outcome, str(message.step), message.time)
            case repair.Repaired():
                self._repairs += 1
                self._add("repaired", [str(step) for step in message.actions])
            case repair.GaveUp():
                self._repairs += 1
                self._add("gave up", [*message.components, message.why])
            case _:
                raise AssertionError(message)

    @hf.on(Until)
    def _until(self, message: Until) -> hf.ReplyHandle[None]:
        handle: hf.ReplyHandle[None] = self.ctx.reply_handle()
        self._waiting = message, handle
        self._add("waiting", list(message.literals))
        return handle

    @hf.on(GetLines)
    def _get(self, message: GetLines) -> list[Line]:
        return self._lines


# -- the scenarios ---------------------------------------------------------------------------------------------------


class Told(msgspec.Struct):
    """A scenario: its lines from its beginning, in seconds, until everything is well again.

    Attributes:
        own: seconds that the slowest device takes to start.
        beyond: seconds that all of it took beyond that.
    """

    scenario: str
    lines: list[Line]
    seconds: float
    own: float
    beyond: float


ALL_DOWN: Final = (
    *(f"not on({device})" for device in CHANNELS),
    *(f"not running({node})" for node in NODES if node != "rviz"),
    *(f"not ok({topic})" for topic in OBSERVED),
    "running(rviz)",
)
ALL_WELL: Final = (
    *(f"on({device})" for device in CHANNELS),
    *(f"running({node})" for node in NODES),
    *(f"ok({topic})" for topic in OBSERVED),
)


async def play(scenario: str, board: str | None) -> Told:
    """One scenario on a robot of its own. `board` is the URL of a real one."""
    is_off = scenario == "power-up"
    async with hf.ActorSystem("robot", log=False) as system:
        recorder = system.spawn(hf.start(Recorder), name="recorder")
        if board is None:
            defaults = (PC,) if is_off else (PC, *CHANNELS.values())
            simulator = system.spawn(hf.start(BoardSimulator, defaults=defaults), name="board")
            board = (await simulator.ask(GetBoard())).url
        async with Board(board) as hand:  # A person's hand on the board's switches.
            for channel in CHANNELS.values():
                await hand.switch(channel, not is_off)
            devices = (hf.child(name, hf.start(Device, CHANNELS.get(name), BOOT[name])) for name in BOOT)
            await system.start(hf.supervisor("devices", children=devices))
            nodes = (hf.child(name, start, isolation="process") for name, start in NODES.items())
            supervisor = await system.start(hf.supervisor("nodes", children=nodes))
            if is_off:
                for name in NODES:
                    if name != "rviz":  # It runs on the operator's computer.
                        await supervisor.ask(TerminateChild(name, parks=False), LONG)
            await system.start(care(board))
            mending = system.ref("/robot/diagnosis/repairer", repair.Repairer)
            first = Until(ALL_DOWN, State.FAULTY) if is_off else Until(ALL_WELL, State.HEALTHY)
            await recorder.ask(first, LONG)
            diagnoser = system.ref("/robot/diagnosis/diagnoser", DiagnoserActor)
            await diagnoser.ask(GetDiagnosis(), LONG)  # Made of all that was observed, not of the first of it.
            await recorder.ask(GetLines())
            await asyncio.sleep(0 if is_off else GRACE)
            began = asyncio.get_running_loop().time()
            mending.tell(repair.SetMode(repair.NORMAL))
            if not is_off:
                await hand.switch(CHANNELS["ja"], False)
            await recorder.ask(Until(ALL_WELL, State.HEALTHY, repairs=1), LONG)
        seconds = asyncio.get_running_loop().time() - began
        lines = await recorder.ask(GetLines())
    own = max(BOOT[name] for name in (CHANNELS if is_off else ("ja",)))
    return Told(scenario, since(lines, began), round(seconds, 3), own, round(seconds - own, 3))


def since(lines: list[Line], began: float) -> list[Line]:
    """The lines from then on, in seconds from then; before them, at 0, how things were."""
    state: dict[str, Line] = {}
    for line in lines:
        if line.time <= began and line.kind in ("observed", "unknown"):
            state[line.what.removeprefix("not ")] = Line(0.0, line.kind, line.what)
    diagnosed = [Line(0.0, "diagnosed", line.what) for line in lines if line.time <= began and line.kind == "diagnosed"]
    later = [
        msgspec.structs.replace(line, time=round(line.time - began, 3))
        for line in lines
        if line.time > began and line.kind != "waiting"
    ]
    return [*state.values(), *diagnosed[-1:], *sorted(later, key=lambda line: line.time)]


# -- how it is told --------------------------------------------------------------------------------------------------

REMARKS: Final = {
    "power-up": (
        "The paper prints the same eleven as bad, and nothing as good: but good and bad together are all components.\n"
        "Its list of actions forgets `jyn`, which is bad and has to be started, and takes 30.2 s."
    ),
    "shut-down": (
        "After the power-up the base and its driver explain the silence alike. Whoever takes the first switches the\n"
        "base off and on for ever; what was just repaired is suspected last, so the driver is restarted."
    ),
}


def text(told: Told) -> str:
    """The time line in words; what is observed only where it changes after the beginning."""
    rows = [f"{told.scenario}:"]
    for line in told.lines:
        if line.kind == "diagnosed":
            what = " or ".join("{" + ", ".join(sorted(one["bad"])) + "}" for one in line.what)
        elif line.kind == "planned":
            what = ", then ".join(" || ".join(stage) for stage in line.what)
        else:
            what = line.what if isinstance(line.what, str) else ", ".join(line.what)
        if line.time or line.kind == "diagnosed":
            rows.append(f"{line.time:8.2f} s  {line.kind:10} {what}")
    rows.append(
        f"{told.seconds:8.2f} s  well again: {told.own:g} s for the devices to start, {told.beyond:.2f} s beyond"
    )
    return "\n".join([*rows, REMARKS[told.scenario], ""])


def draw(told: Told, path: Path) -> None:
    """The time line as a picture: what was observed of each component and topic, and what was done."""
    from matplotlib.figure import Figure  # of the extra `programs`

    atoms = list(dict.fromkeys(line.what.removeprefix("not ") for line in told.lines if line.kind == "observed"))
    steps = list(dict.fromkeys(line.what for line in told.lines if line.kind == "began"))
    rows = {name: place for place, name in enumerate([*steps, *atoms])}
    figure = Figure(figsize=(11, 0.27 * len(rows) + 1.5), layout="constrained")
    axes = figure.add_subplot()
    open_: dict[str, tuple[float, str]] = {}

    def close(row: str, time: float) -> None:
        begun, colour = open_.pop(row, (time, ""))
        axes.broken_barh([(begun, time - begun)], (rows[row] - 0.4, 0.8), color=colour or "none")

    for line in told.lines:
        if line.kind in ("observed", "unknown"):
            row = line.what.removeprefix("not ")
            if row in rows:
                close(row, line.time)
                bad = line.what.startswith("not ")
                open_[row] = line.time, "lightgrey" if line.kind == "unknown" else "indianred" if bad else "seagreen"
        elif line.kind == "began":
            open_[line.what] = line.time, "black"
        elif isinstance(line.what, str) and line.what in open_:  # An action has ended.
            close(line.what, line.time)
        elif line.kind in ("planned", "repaired"):
            axes.axvline(line.time, color="steelblue", linestyle="--", linewidth=1)
            axes.text(line.time, -1.1, line.kind, color="steelblue", ha="center", fontsize=8)
    for row in list(open_):
        close(row, told.seconds)
    axes.set_yticks(list(rows.values()), list(rows), fontsize=8)
    axes.set(xlabel="seconds", xlim=(0, told.seconds * 1.02), ylim=(len(rows) - 0.4, -1.6))
    axes.set_title(f"{told.scenario}: green holds, red does not, grey is unknown; actions in black", fontsize=10)
    figure.savefig(path, dpi=120)


async def main(options: argparse.Namespace) -> None:
    """Play what was asked for, and tell it."""
    scenarios = ("power-up", "shut-down") if options.scenario == "all" else (options.scenario,)
    told = [await play(scenario, options.board) for scenario in scenarios]
    if options.json:
        print(json.dumps(msgspec.to_builtins(told)))
    else:
        print("\n".join(map(text, told)))
    for one in told if options.png else ():
        draw(one, Path(options.png) / f"{one.scenario}.png")


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=sys.modules["__main__"].__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("scenario", nargs="?", default="all", choices=["all", "power-up", "shut-down"])
    parser.add_argument("--board", metavar="tcp://HOST:PORT", help="a real power board, with the devices on 0, 3 and 5")
    parser.add_argument("--json", action="store_true", help="print data instead of text")
    parser.add_argument("--png", metavar="FOLDER", help="also draw the time lines into it")
    return parser.parse_args()


if __name__ == "__main__":
    hf.run(main(arguments()))
