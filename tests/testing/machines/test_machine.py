"""The machine finds planted bugs, whose examples can be repeated, and finds nothing in what is right."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections.abc import Mapping
from typing import Any, ClassVar

import hypothesis.strategies as st
import pytest
from hypothesis import Phase, settings
from hypothesis.internal.conjecture import engine
from hypothesis.stateful import precondition, rule, run_state_machine_as_test

import holdfast as hf
from holdfast.testing import ActorMachine, Model, NotLinearizable
from holdfast.testing.schedules.choices import UnfitSchedule
from holdfast.testing.schedules.world import EscapesSimulation

STEPS = 6
QUICK = settings(
    max_examples=30,
    stateful_step_count=STEPS,
    deadline=None,
    report_multiple_bugs=False,
    phases=[Phase.generate, Phase.shrink],
)


class Add(hf.Message[int]):
    amount: int


class Get(hf.Message[int]): ...


class Put(hf.Message[None]):
    value: int


class Account(hf.Actor):
    def __init__(self) -> None:
        self.value = 0

    @hf.on(Get)
    def get(self, message: Get) -> int:
        return self.value

    @hf.on(Put)
    def put(self, message: Put) -> None:
        self.value = message.value

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.value += message.amount
        return self.value


class Adder(hf.Actor):
    """Reads, and writes what it has read and some more: between the two another one may write."""

    def __init__(self, account: hf.ActorRef) -> None:
        self.account = account

    @hf.on(Add)
    async def add(self, message: Add) -> int:
        value = await self.account.ask(Get()) + message.amount
        await self.account.ask(Put(value))
        return value


def counter(value: int, message: Add | Get) -> tuple[int, int]:
    after = value + message.amount if isinstance(message, Add) else value
    return after, after


class LostUpdate(ActorMachine):
    """Two who add without looking at each other."""

    model = Model(0, counter)

    def set_up(self) -> None:
        account = self.spawn(hf.start(Account), "account")
        self.adders = [self.spawn(hf.start(Adder, account), name) for name in ("one", "other")]

    @rule(which=st.integers(0, 1), amount=st.integers(1, 9))
    def add(self, which: int, amount: int) -> None:
        self.ask(self.adders[which], Add(amount))


class OneAdder(LostUpdate):
    """As it should be: all goes through one of them."""

    def set_up(self) -> None:
        super().set_up()
        self.adders[1] = self.adders[0]


class Crashes(ActorMachine):
    """An account that is crashed: its model expects that it keeps its value."""

    model = Model(0, counter)
    recovery: Any = None

    def set_up(self) -> None:
        self.account = self.start(hf.child("account", hf.start(Account), recovery=self.recovery))

    @rule(amount=st.integers(1, 9))
    def add(self, amount: int) -> None:
        self.ask(self.account, Add(amount))

    @rule()
    def get(self) -> None:
        self.ask(self.account, Get())

    @rule()
    def crash(self) -> None:
        self.crash_actor(self.account)


class CrashesRecorded(Crashes):
    recovery = hf.hybrid()


class Killed(Crashes):
    """As CrashesRecorded, in a process of its own that is killed."""

    latency = (0.0, 0.01)

    def set_up(self) -> None:
        spec = hf.child("account", hf.start(Account), isolation="process", recovery=hf.hybrid())
        self.account = self.start(spec)

    @rule()
    def crash(self) -> None:
        self.kill_process(self.account)


class PowerCut(CrashesRecorded):
    """As CrashesRecorded, with a root that loses its power."""

    options: ClassVar[Mapping[str, Any]] = {"store": "simulated", "durability": "fsync"}

    @rule()
    def crash(self) -> None:
        self.crash_root(power=True)
        self.set_up()


class PowerCutUnsynced(PowerCut):
    """What is acknowledged was only written."""

    options: ClassVar[Mapping[str, Any]] = {"store": "simulated", "durability": "os"}


class Draw(hf.Message[int]): ...


class Last(hf.Message[int]): ...


class Tickets(hf.Actor):
    """Gives numbers by the clock, and says what the last one was."""

    def __init__(self) -> None:
        self.last = 0

    def now(self) -> float:
        return self.ctx.now()

    @hf.on(Draw)
    def draw(self, message: Draw) -> int:
        self.last = round(self.now())
        return self.last

    @hf.on(Last)
    def tell_last(self, message: Last) -> int:
        return self.last


class TicketsByTheWorld(Tickets):
    """A replay asks the clock of the world again."""

    def now(self) -> float:
        return time.time()


class Drawing(ActorMachine):
    kind: type[Tickets] = Tickets

    def set_up(self) -> None:
        self.last = 0
        self.tickets = self.start(hf.child("tickets", hf.start(self.kind), recovery=hf.hybrid(interval=1e6)))

    @rule()
    def draw(self) -> None:
        self.last = self.wait(self.ask(self.tickets, Draw()))

    @rule(seconds=st.integers(1, 3600))
    def pass_time(self, seconds: int) -> None:
        self.advance(seconds)

    @rule()
    def crash(self) -> None:
        self.crash_actor(self.tickets)

    @rule()
    @precondition(lambda self: self.last)
    def look(self) -> None:
        assert self.wait(self.ask(self.tickets, Last())) == self.last


class DrawingByTheWorld(Drawing):
    """It crashes for ever; its rules crash it less often than its root allows."""

    options: ClassVar[Mapping[str, Any]] = {"intensity": STEPS}
    kind = TicketsByTheWorld


RIGHT = [OneAdder, CrashesRecorded, Killed, PowerCut, Drawing]
WRONG: list[tuple[type[ActorMachine], tuple[type[BaseException], ...]]] = [
    (LostUpdate, (NotLinearizable,)),
    (Crashes, (NotLinearizable,)),
    (PowerCutUnsynced, (NotLinearizable,)),
    (DrawingByTheWorld, (AssertionError, hf.HoldfastError)),
]


@pytest.mark.parametrize("machine", RIGHT)
def test_nothing_is_found_in_what_is_right(machine: type[ActorMachine]) -> None:
    run_state_machine_as_test(machine, settings=QUICK)


@pytest.mark.parametrize(("machine", "errors"), WRONG)
@pytest.mark.some(2)
def test_a_planted_bug_is_found_and_its_example_can_be_repeated(
    machine: type[ActorMachine], errors: tuple[type[BaseException], ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(machine, "shrink_seconds", 300.0)  # The computer may do other things, too.
    with pytest.raises(errors) as caught:
        run_state_machine_as_test(machine, settings=settings(QUICK, max_examples=200))
    notes = "\n".join(caught.value.__notes__)
    assert "cut short" not in notes
    lines = re.findall(r"^state\.(\w+)\((.*)\)$", notes, re.M)
    schedule = re.search(r'schedule="([^"]*)"', notes)
    assert schedule is not None
    assert len(lines) <= 8
    assert re.search(r"^the \d+ turns ", notes, re.M)
    with pytest.raises(errors) as again:
        repeat(machine, schedule[1], notes)
    assert type(again.value) is type(caught.value)


class Hurried(LostUpdate):
    """Has no time to look for a simpler example."""

    shrink_seconds = 0.0


def test_shrinking_ends_within_its_time_and_says_that_it_was_cut_short() -> None:
    own = engine.MAX_SHRINKING_SECONDS
    with pytest.raises(NotLinearizable) as caught:
        run_state_machine_as_test(Hurried, settings=settings(QUICK, max_examples=200))
    assert "shrinking was cut short after 0 s" in "\n".join(caught.value.__notes__)
    assert own == engine.MAX_SHRINKING_SECONDS


def test_a_time_for_shrinking_that_cannot_be_is_refused() -> None:
    with pytest.raises(ValueError, match=r"Wrong\.shrink_seconds must be >= 0 seconds, not -1"):
        type("Wrong", (ActorMachine,), {"shrink_seconds": -1})


def repeat(machine: type[ActorMachine], schedule: str, notes: str) -> None:
    """Do what Hypothesis has printed, with the schedule of the note."""
    state = machine(schedule=schedule)
    try:
        for line in re.findall(r"^state\.(\w+\(.*\))$", notes, re.M):
            if not line.startswith("teardown"):
                eval(f"state.{line}", {"state": state})
    finally:
        state.teardown()


def test_a_schedule_of_another_example_is_an_error_of_the_machine() -> None:
    for schedule, fits in (("seed=1", True), ("seed=1 hold=900:1", False)):
        state = CrashesRecorded(schedule=schedule)
        state.add(amount=1)
        if fits:
            state.teardown()
        else:
            with pytest.raises(UnfitSchedule, match=r"hold=900:1 was not come to, for the run has \d+ such choices"):
                state.teardown()


def test_a_rule_that_hides_a_method_of_the_machine_is_refused() -> None:
    with pytest.raises(TypeError, match=r"Hiding\.advance would hide ActorMachine\.advance"):
        type("Hiding", (ActorMachine,), {"advance": lambda self: None})


def test_without_hypothesis_the_kit_works_and_the_machine_names_its_extra() -> None:
    program = (
        "import sys; sys.modules['hypothesis'] = None; from holdfast.testing import GuardedSystem, simulate; "
        "from holdfast.testing import ActorMachine"
    )
    done = subprocess.run([sys.executable, "-c", program], check=False, capture_output=True, text=True, timeout=60)
    assert "pip install 'holdfast[machines]'" in done.stderr.splitlines()[-1]


class Broken(ActorMachine):
    def set_up(self) -> None:
        self.spawn(hf.start(Account))
        raise LookupError("in set_up")


def test_a_machine_that_cannot_be_set_up_leaves_nothing_behind() -> None:
    before = time.time
    with pytest.raises(LookupError):
        Broken()
    assert time.time is before


class Note(hf.Message):
    text: str


class Reader(hf.Actor):
    @hf.on(Note)
    def read(self, message: Note) -> None:
        pass


class Shown:
    """Has the text of `object`."""


class ShowsAnAddress(ActorMachine):
    def set_up(self) -> None:
        self.shown = Shown()
        self.reader = self.start(hf.child("reader", hf.start(Reader)))

    @rule()
    def read(self) -> None:
        self.tell(self.reader, Note(f"from {self.shown}"))


def test_an_address_in_a_message_is_told() -> None:
    with pytest.warns(EscapesSimulation, match=r"Note to /app/reader shows the address of an object \(Shown\)"):
        run_state_machine_as_test(ShowsAnAddress, settings=settings(max_examples=2, stateful_step_count=2))
