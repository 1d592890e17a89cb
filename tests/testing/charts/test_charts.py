"""The chart of a failure shows what led to it, and nothing else; all of it is there, too."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.testing import GuardedSystem, advance, idle, probe, simulate
from holdfast.testing.charts.causes import leading
from holdfast.testing.charts.chart_html import as_html
from holdfast.testing.charts.chart_recorder import Recorder
from holdfast.testing.charts.chart_text import as_text, short
from holdfast.testing.schedules.choices import Production
from holdfast.testing.simulation import run_schedule
from tests.testing.schedules.planted import (
    PLANTED,
    Account,
    Adder,
    Closer,
    Directory,
    Get,
    Go,
    Lock,
    Note,
    Philosopher,
    Put,
    Step,
    Teller,
    Work,
)
from tests.testing.suites import HEAD, run_suite

Program = Callable[[GuardedSystem], Coroutine[Any, Any, None]]


def bystanders(system: GuardedSystem, count: int = 20) -> None:
    for number in range(count):
        system.spawn(hf.start(Account), f"bystander{number}").tell(Put(number))


def run(program: Program) -> tuple[Recorder, BaseException]:
    """The run of a program that fails, in the order of production."""
    recorder = Recorder()
    with pytest.raises(BaseException) as raised:  # noqa: PT011  # Each test looks at what it was.
        run_schedule(program, Production(0), {"system"}, {}, recorder)
    return recorder, raised.value


def led(program: Program) -> list[str]:
    """The turns that lead to the failure of a program: whose, and what."""
    recorder, failure = run(program)
    assert isinstance(failure, AssertionError | hf.HoldfastError), failure
    return [f"{short(row.path)} {row.what.partition('(')[0]}" for row in leading(recorder, failure)]


async def lost_update_beside_others(system: GuardedSystem) -> None:
    bystanders(system)
    await PLANTED["lost_update"](system)


async def one_after_the_other(system: GuardedSystem, **options: Any) -> None:
    """Two add to an account, one after the other, and a third has an account of its own."""
    account, bystander = [
        await system.start(hf.child(name, hf.start(Account), **options)) for name in ("account", "bystander")
    ]
    await bystander.ask(Put(1))
    for name in ("one", "other"):
        adder = await system.start(hf.child(name, hf.start(Adder), **options))
        await adder.ask(Work(account))
    assert await account.ask(Get()) == 3


async def of_recorded_actors(system: GuardedSystem) -> None:
    await one_after_the_other(system, recovery=hf.hybrid())


async def of_processes(system: GuardedSystem) -> None:
    await one_after_the_other(system, isolation="process")


async def of_recorded_processes(system: GuardedSystem) -> None:
    await one_after_the_other(system, isolation="process", recovery=hf.hybrid())


@pytest.mark.parametrize("program", [of_recorded_actors, of_processes, of_recorded_processes])
def test_turns_of_the_library_are_left_out_and_messages_are_decoded(program: Program) -> None:
    recorder, failure = run(program)
    lines = as_text(leading(recorder, failure), recorder.rows).splitlines()
    assert lines[0] == "the 7 turns that lead to it (1 turn of 1 other actor left out):"
    assert lines[1].split() == ["one", "account", "other"]
    assert [re.sub(r"^ +[\d.]+ +[|*+<> -]+", "", line).rstrip() for line in lines[2:]] == [
        "Work(to=<ActorRef /app/account>)",
        "Get()",
        "Put(value=1)   [value: 0 -> 1]",
        "Work(to=<ActorRef /app/account>)",
        "Get()",
        "Put(value=2)   [value: 1 -> 2]",
        "Get()",
    ]


def test_bystanders_are_left_out() -> None:
    with pytest.raises(AssertionError) as raised:
        simulate(lost_update_beside_others)()
    lines = raised.value.__notes__[0].splitlines()
    assert lines[2] == "the 7 turns that lead to it (20 turns of 20 other actors left out):"
    assert sorted(lines[3].split()) == ["account", "one", "other"]
    assert len([line for line in lines if re.match(r" +\d+\.\d{3} ", line)]) == 7
    assert not [line for line in lines[2:11] if "bystander" in line]


async def of_what_the_test_has_heard(system: GuardedSystem) -> None:
    bystanders(system)
    note = system.spawn(hf.start(Account), "account")
    got = await asyncio.gather(note.ask(Get()), system.spawn(hf.start(Account), "another").ask(Get()))
    wrong = sum(got)
    assert wrong


async def of_a_future(system: GuardedSystem) -> None:
    bystanders(system)
    await system.spawn(hf.start(Account), "another").ask(Get())
    got = system.spawn(hf.start(Account), "account").ask(Get())
    await got
    assert got.result() == 1


async def of_a_probe(system: GuardedSystem) -> None:
    bystanders(system)
    heard = probe(system, "probe")
    system.spawn(hf.start(Teller, heard.ref, 7), "teller").tell(Go())
    await idle(system)
    assert heard.waiting[-1] == Step(8)


class Clock(hf.Actor):
    def __init__(self, to: hf.ActorRef) -> None:
        self.to = to

    @hf.on(Go)
    def go(self, message: Go) -> None:
        self.ctx.tell_after(1.0, Step(1))

    @hf.on(Step)
    def step(self, message: Step) -> None:
        self.ctx.spawn(hf.start(Teller, self.to, 3), "child").tell(Go())


async def of_a_timer_and_a_child(system: GuardedSystem) -> None:
    bystanders(system)
    note = system.spawn(hf.start(Note), "note")
    system.spawn(hf.start(Clock, note), "clock").tell(Go())
    await advance(2.0)
    actor: Any = note._cell.actor
    assert actor.got == []


class Desk(hf.Actor):
    """Hands on what it is asked."""

    def __init__(self, to: hf.ActorRef) -> None:
        self.to = to

    @hf.on(Get)
    def get(self, message: Get) -> Any:
        self.ctx.forward(self.to)


async def of_what_was_forwarded(system: GuardedSystem) -> None:
    bystanders(system)
    account = system.spawn(hf.start(Account), "account")
    desk = system.spawn(hf.start(Desk, account), "desk")
    assert await desk.ask(Get()) == 1


class Keeper(hf.Actor):
    """Answers later, when it is told."""

    def __init__(self) -> None:
        self.waiting: Any = None

    @hf.on(Get)
    def get(self, message: Get) -> Any:
        self.waiting = self.ctx.reply_handle()
        return self.waiting

    @hf.on(Step)
    def step(self, message: Step) -> None:
        self.waiting.reply(message.number)


async def of_a_reply_that_another_turn_gave(system: GuardedSystem) -> None:
    bystanders(system)
    keeper = system.spawn(hf.start(Keeper), "keeper")
    got = keeper.ask(Get())
    await idle(system)
    system.spawn(hf.start(Teller, keeper, 3), "teller").tell(Go())
    number = await got
    assert number == 4


async def of_one_that_was_stopped(system: GuardedSystem) -> None:
    bystanders(system)
    server, other = (system.spawn(hf.start(Account), name) for name in ("server", "other"))
    system.spawn(hf.start(Closer, server), "closer").tell(Go())
    await idle(system)
    await system.spawn(hf.start(Directory, server), "directory").ask(Work(other))


async def of_two_that_wait_for_each_other(system: GuardedSystem) -> None:
    bystanders(system)
    locks = [system.spawn(hf.start(Lock), f"lock{number}") for number in range(2)]
    one, two = (
        system.spawn(hf.start(Philosopher, *pair), f"philosopher{number}")
        for number, pair in enumerate((locks, locks[::-1]))
    )
    waits = one.ask(Work(locks[0]), timeout=1.0)
    two.tell(Work(locks[0]))
    await waits


class Fails(hf.Actor):
    @hf.on(Go)
    def go(self, message: Go) -> None:
        raise RuntimeError("as planned")


async def of_one_that_crashes(system: GuardedSystem) -> None:
    bystanders(system)
    system.spawn(hf.start(Fails), "weak").tell(Go())
    await idle(system)


@pytest.mark.parametrize(
    ("program", "turns"),
    [
        (of_what_the_test_has_heard, ["account Get", "another Get"]),
        (of_a_future, ["account Get"]),
        (of_a_probe, ["teller Go", "probe Step"]),
        (of_a_timer_and_a_child, ["clock Go", "clock Step", "child Go", "note Step"]),
        (of_what_was_forwarded, ["desk Get", "account Get"]),
        (of_a_reply_that_another_turn_gave, ["keeper Get", "teller Go", "keeper Step"]),
        (
            of_one_that_was_stopped,
            ["closer Go", "directory Work", "other Get", "directory its turn raises ActorStopped"],
        ),
        (
            of_two_that_wait_for_each_other,
            [
                "philosopher0 Work",
                "philosopher1 Work",
                "lock0 Take",
                "lock1 Take",
                "lock1 Take",
                "lock0 Take",
            ],
        ),
        (of_one_that_crashes, ["weak Go"]),
    ],
    ids=lambda given: given.__name__ if callable(given) else "",
)
def test_what_leads_to_a_failure_is_found(program: Program, turns: list[str]) -> None:
    assert led(program) == turns


def test_all_turns_are_behind_a_switch() -> None:
    recorder, failure = run(of_a_future)
    rows = leading(recorder, failure)
    page = as_html(rows, recorder.rows, "a title", "a <note>")
    first, whole = page.split('<div class="whole">')
    assert "bystander3" not in first.partition("<body>")[2] + first.partition("<h1>")[2]
    assert all(f"bystander{number}" in whole for number in range(20))
    assert f"show all {len(recorder.rows)} turns" in first
    assert "a &lt;note&gt;" in page
    assert "show all" not in as_html(rows, rows, "a title", "a note")


def test_a_chart_of_many_has_a_line_for_each() -> None:
    async def many(system: GuardedSystem) -> None:
        note = system.spawn(hf.start(Note), "note")
        for number in range(50):
            system.spawn(hf.start(Teller, note, number), f"teller{number}").tell(Go())
        await idle(system)
        raise AssertionError(note)

    recorder, failure = run(many)
    lines = as_text(leading(recorder, failure), recorder.rows).splitlines()
    assert lines[0] == "the last 40 of the 100 turns of the run:"
    assert len(lines) == 41
    assert re.match(r" +0\.000  /app/teller\d+ -> /app/note: Step\(number=\d+\)", lines[-1])
    assert as_text([], []) == ""


FAILS = """
from holdfast.testing import simulate

@simulate(seeds=3)
async def test_it(system):
    for number in range(4):
        system.spawn(hf.start(Counter), f"bystander{number}").tell(Add(number))
    assert await system.spawn(hf.start(Counter), "counter").ask(Add(1)) == 2
"""


def test_the_files_have_all_turns(pytester: pytest.Pytester) -> None:
    run_suite(pytester, HEAD + FAILS, "--holdfast-record", "artefacts")
    [folder] = Path(pytester.path / "artefacts").iterdir()
    told = (folder / "failure.txt").read_text("utf-8")
    assert "the 1 turn that leads to it (4 turns of 4 other actors left out):" in told
    assert told.count("/app/bystander") == 4
    assert (folder / "chart.html").read_text("utf-8").count("<title>/app/bystander") == 4
