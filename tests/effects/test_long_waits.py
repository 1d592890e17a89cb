"""Turns that wait for a moment or for a message, over the end of their process, of their life and of the program."""

from __future__ import annotations

import asyncio
import os
import signal
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.checkpoint.home.recorded_home import switch_of
from holdfast.testing import advance
from tests.checkpoint.test_commits import Slow
from tests.effects.clerk import lines
from tests.effects.patient import IN_TIME, Call, Count, Go, Look, Never, Patient, patient

DAY = 86400.0
VIRTUAL = pytest.mark.asyncio(loop_factories=["virtual"])


def running(tmp_path: Path, durability: str = "memory") -> hf.ActorSystem:
    store = None if durability == "memory" else f"sqlite:{tmp_path / 'app.db'}"
    return hf.ActorSystem("app", log=False, store=store, intensity=99)


async def waits(system: hf.ActorSystem, path: str = "/app/patient") -> None:
    """Wait until the turn of the patient waits, and its home knows."""
    async with asyncio.timeout(IN_TIME):
        while not ((home := switch_of(system._node.cell_at(path))) and home.calls.rests.is_busy):
            await asyncio.sleep(0.001)


async def end_of(system: hf.ActorSystem, isolation: str, path: str = "/app/patient") -> None:
    """End the life in the middle of its turn, and wait until the next one is there."""
    with system.events() as stream:
        if isolation == "process":
            os.kill(system.pid_of(system.ref(path, hf.Actor)), signal.SIGKILL)
        else:
            system.ref(path, hf.Actor).kill()
        async with asyncio.timeout(IN_TIME):
            async for event in stream:
                if isinstance(event, hf.events.Recovered):
                    return


# -- moments ---------------------------------------------------------------------------------------------------------


@VIRTUAL
async def test_days_pass_and_crashes_make_them_no_longer(tmp_path: Path) -> None:
    async with running(tmp_path) as system:
        ref = await system.start(patient())
        begin = ref.ask(Count())
        assert await begin == 1
        asked = asyncio.ensure_future(ref.ask(Go([f"s{10 * DAY}", f"s{5 * DAY}"]), 30 * DAY))
        loop = asyncio.get_running_loop()
        start = loop.time()
        for _ in range(4):
            await advance(3 * DAY)
            await end_of(system, "task")
        assert await asked == "slept, slept"
        assert 15 * DAY <= loop.time() - start < 15.01 * DAY


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_moment_that_has_passed_ends_the_wait_at_once(tmp_path: Path, isolation: str) -> None:
    async with running(tmp_path) as system:
        ref = await system.start(patient(isolation))
        assert await ref.ask(Go(["s0", "s0.0", "u0.0", "u-5"]), IN_TIME) == "slept, slept, slept, slept"


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_what_comes_meanwhile_is_handled_behind(tmp_path: Path, isolation: str) -> None:
    async with running(tmp_path) as system:
        ref = await system.start(patient(isolation))
        asked = ref.ask(Go(["s0.2"]), IN_TIME)
        counts = [ref.ask(Count(), IN_TIME) for _ in range(3)]
        order: list[object] = []
        asked.add_done_callback(lambda done: order.append(done.result()))
        for one in counts:
            one.add_done_callback(lambda done: order.append(done.result()))
        assert await asyncio.gather(*counts) == [1, 2, 3]
        assert order == ["slept", 1, 2, 3]


# -- messages --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("mailbox", [None, hf.bounded(8)])
async def test_the_message_that_has_waited_longest_is_taken_from_the_mailbox(
    tmp_path: Path, isolation: str, mailbox: Any
) -> None:
    """Before all that came earlier; whoever has asked hears that it was taken."""
    async with running(tmp_path) as system:
        ref = await system.start(patient(isolation, mailbox=mailbox))
        with system.events() as stream:
            asked = ref.ask(Go(["s0.1", "c", "c", "c"]), IN_TIME)
            count = ref.ask(Count(), IN_TIME)
            ref.tell(Call("first"))
            second = ref.ask(Call("second"), IN_TIME)
            ref.tell(Never())
            assert await asked == "slept, call first, call second, never"
            await second
            assert await count == 1
            assert await ref.ask(Look(), IN_TIME) == ["slept, call first, call second, never"]
            assert not [event for event in stream.take() if isinstance(event, hf.events.ActorCrashed)]


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_the_first_that_comes_is_taken_and_no_other(tmp_path: Path, isolation: str) -> None:
    async with running(tmp_path) as system:
        ref = await system.start(patient(isolation))
        asked = ref.ask(Go(["c"]), IN_TIME)
        await waits(system)
        for word in ("a", "b"):
            ref.tell(Call(word))
        assert await asked == "call a"
        assert await ref.ask(Look(), IN_TIME) == ["call a", "no turn has waited for b"]


@VIRTUAL
async def test_a_time_limit_is_an_outcome(tmp_path: Path) -> None:
    async with running(tmp_path) as system:
        ref = await system.start(patient())
        asked = asyncio.ensure_future(ref.ask(Go([f"c{DAY}", "c"]), 9 * DAY))
        await advance(2 * DAY)
        await end_of(system, "task")
        ref.tell(Call("late"))
        said = await asked
        assert said.startswith("/app/patient has waited for tests.effects.patient:Call or ")
        assert said.endswith(", call late")


# -- ends ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("durability", ["memory", "os"])
@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_turn_waits_on_whatever_ends(tmp_path: Path, isolation: str, durability: str) -> None:
    """Ended more often than a message may end a process: it was not at work."""
    world = str(tmp_path / "world")
    async with running(tmp_path, durability) as system:
        ref = await system.start(patient(isolation))
        asked = asyncio.ensure_future(ref.ask(Go(["e", "c", "c", "e"], world), IN_TIME))
        for word in ("a", "b"):
            for _ in range(4):
                await waits(system)
                await end_of(system, isolation)
            await waits(system)
            await ref.ask(Call(word), IN_TIME)
        assert await asked == "effect 1, call a, call b, effect 2"
        assert len(lines(world)) == 2
        await end_of(system, "task")  # A replay of the whole turn.
        assert await ref.ask(Look(), IN_TIME) == ["effect 1, call a, call b, effect 2"]
        assert len(lines(world)) == 2


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_turn_goes_on_in_the_next_program(tmp_path: Path, isolation: str) -> None:
    """An orderly stop does not wait for it, however long it may."""
    world = str(tmp_path / "world")
    async with running(tmp_path, "os") as system:
        ref = await system.start(patient(isolation, shutdown="infinity"))
        ref.tell(Go(["e", "c", "s0.3", "c"], world))
        await waits(system)
    async with running(tmp_path, "os") as system:
        ref = await system.start(patient(isolation, shutdown="infinity"))
        await ref.ask(Call("a"), IN_TIME)
        await waits(system)
    async with running(tmp_path, "os") as system:
        ref = await system.start(patient(isolation))
        ref.tell(Call("b"))
        assert await ref.ask(Look(), IN_TIME) == ["effect 1, call a, slept, call b"]
        assert len(lines(world)) == 1


class Waiting(hf.Actor):
    """A turn that has an effect, or asks, and rests behind that."""

    def __init__(self) -> None:
        self.said: list[str] = []

    @hf.on(Go)
    async def go(self, message: Go) -> str:
        for step in message.steps:
            match step:
                case "effect":
                    self.said.append(await self.ctx.effect(opened, message.file, key="opened"))
                case "ask":
                    self.said.append(await self.ctx.find("/app/keeper", Keeper).ask(Open(message.file), IN_TIME))
                case "sleep":
                    await self.ctx.sleep(0.3)
                case "long":
                    await self.ctx.sleep(3600.0)
                case _:
                    self.said.append((await self.ctx.wait_for(Call, timeout=3600.0)).word)
        return ", ".join(self.said)

    @hf.on(Call)
    def call(self, message: Call) -> None: ...

    @hf.on(Look)
    def look(self, message: Look) -> list[str]:
        return self.said


class Open(hf.Message[str]):
    file: str


class Keeper(hf.Actor):
    @hf.on(Open)
    async def open(self, message: Open) -> str:
        return await opened(message.file)


async def opened(file: str) -> str:
    """Wait until the file is there, having said so."""
    Path(f"{file}.asked").touch()
    while not Path(file).exists():
        await asyncio.sleep(0.005)
    return "opened"


@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("first", ["effect", "ask"])
@pytest.mark.parametrize("rest", [["call"], ["sleep", "call"], ["long"]], ids="-".join)
async def test_a_stop_that_comes_before_the_turn_rests_ends_it_when_it_does(
    tmp_path: Path, isolation: Any, first: str, rest: list[str]
) -> None:
    gate = tmp_path / "gate"
    spec: Any = hf.child(
        "waiting", hf.start(Waiting), isolation=isolation, recovery=hf.hybrid(interval=1000.0), shutdown="infinity"
    )
    async with running(tmp_path, "os") as system:
        await system.start(hf.child("keeper", hf.start(Keeper)))
        ref = await system.start(spec)
        ref.tell(Go([first, *rest], str(gate)))
        async with asyncio.timeout(IN_TIME):
            while not Path(f"{gate}.asked").exists():
                await asyncio.sleep(0.005)
            order = hf.RestartChild("waiting", running=True)
            restarted = asyncio.ensure_future(system.ref("/app", hf.Supervisor).ask(order, IN_TIME))
            await asyncio.sleep(0)  # It has been told.
            gate.touch()
            await restarted
        if rest != ["long"]:
            ref.tell(Call("came"))
            assert await ref.ask(Look(), IN_TIME) == ["opened", "came"]


@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("below", ["root", "supervisor", "process"])
async def test_a_turn_that_was_asked_goes_on_too(tmp_path: Path, isolation: Any, below: str) -> None:
    """Its asker is told that it has ended; what it has done is not left half done. The stop waits nowhere."""
    world = str(tmp_path / "world")
    inner = patient(isolation, shutdown="infinity")
    spec: Any = inner
    if below != "root":
        spec = hf.supervisor("team", children=[inner], isolation="task" if below == "supervisor" else "process")
    path = "/app/patient" if below == "root" else "/app/team/patient"
    async with running(tmp_path, "os") as system:
        await system.start(spec)
        asked = system.ref(path, Patient).ask(Go(["e", "c", "e"], world), IN_TIME)
        await waits(system, path)
    with pytest.raises(hf.AskFailed):
        await asked
    async with running(tmp_path, "os") as system:
        await system.start(spec)
        ref = system.ref(path, Patient)
        await ref.ask(Call("a"), IN_TIME)
        assert await ref.ask(Look(), IN_TIME) == ["effect 1, call a, effect 2"]
        assert len(lines(world)) == 2


class Tell(hf.Message):
    verb: str = "tell"


class Heard(hf.Message[list[int]]): ...


class Teller(hf.Actor):
    def __init__(self) -> None:
        self.heard: list[int] = []

    @hf.on(Tell)
    async def tell_other(self, message: Tell) -> None:
        await self.ctx.wait_for(Never)
        other = self.ctx.find("/app/other", Patient)
        match message.verb:
            case "tell":
                other.tell(Call("hello"))
            case "send":
                await other.send(Call("hello"))
            case _:
                self.heard.append(await other.ask(Count(), timeout=60.0))

    @hf.on(Never)
    def never(self, message: Never) -> None: ...

    @hf.on(Heard)
    def tell_heard(self, message: Heard) -> list[int]:
        return self.heard


@pytest.mark.parametrize("verb", ["tell", "send"])
@pytest.mark.parametrize("ends", [0, 1])
@pytest.mark.parametrize("method", [hf.hybrid(interval=1000.0), hf.replay_only()])
async def test_what_is_told_to_somebody_who_is_not_started_yet_waits_for_that(
    tmp_path: Path, method: Any, ends: int, verb: str
) -> None:
    """Over the end of one more program, too; and it comes once, also if no snapshot cuts the journal."""
    teller = hf.child("patient", hf.start(Teller), recovery=hf.hybrid(interval=1000.0))
    other = hf.child("other", hf.start(Patient), recovery=method)
    async with running(tmp_path, "os") as system:
        await system.start(other)
        ref = await system.start(teller)
        ref.tell(Tell(verb))
        await waits(system)
    async with running(tmp_path, "os") as system:
        ref = await system.start(teller)
        await ref.ask(Never(), IN_TIME)
        await ref.ask(Never(), IN_TIME)  # Behind the turn that has told.
        if not ends:
            found = await system.start(other)
            assert await found.ask(Look(), IN_TIME) == ["no turn has waited for hello"]
        assert system.dead_letters == 0
    for _ in range(2):
        async with running(tmp_path, "os") as system:
            found = await system.start(other)
            assert await found.ask(Look(), IN_TIME) == ["no turn has waited for hello"]
            found.kill()
            assert await found.ask(Look(), IN_TIME) == ["no turn has waited for hello"]


@pytest.mark.parametrize(("ends", "is_first"), [(0, False), (1, False), (1, True), (2, True)])
async def test_what_is_asked_of_somebody_who_is_not_started_yet_is_answered_then(
    tmp_path: Path, ends: int, is_first: bool
) -> None:
    """Over so many ends of the program; `is_first`: in the last one, whoever was asked is started first."""
    teller = hf.child("patient", hf.start(Teller), recovery=hf.hybrid(interval=1000.0), shutdown=0.1)
    other = hf.child("other", hf.start(Patient), recovery=hf.hybrid(interval=1000.0))
    async with running(tmp_path, "os") as system:
        found, ref = await system.start(other), await system.start(teller)
        assert await found.ask(Count(), IN_TIME) == 1
        ref.tell(Tell("ask"))
        await waits(system)
    for program in range(ends + 1):
        async with running(tmp_path, "os") as system:
            if program == ends and is_first:
                await system.start(other)
            ref = await system.start(teller)
            if not program:
                await ref.send(Never())
                home = switch_of(system._node.cell_at("/app/patient"))
                async with asyncio.timeout(IN_TIME):
                    while home is None or not home.calls.asks:
                        await asyncio.sleep(0.001)
            if program == ends:
                found = system.ref("/app/other", Patient) if is_first else await system.start(other)
                assert await ref.ask(Heard(), IN_TIME) == [2]
                assert await found.ask(Count(), IN_TIME) == 3
            assert system.dead_letters == 0
    async with running(tmp_path, "os") as system:
        ref, found = await system.start(teller), await system.start(other)
        assert await ref.ask(Heard(), IN_TIME) == [2]
        assert await found.ask(Count(), IN_TIME) == 4


class Begin(hf.Message[list[str]]): ...


async def test_what_a_life_wanted_to_wait_for_begins_only_with_that_life(tmp_path: Path) -> None:
    """It ends before its wish is safe; the next one's turn has the message meanwhile."""
    engine, goes_on = Slow(tmp_path / "app.db"), asyncio.Event()
    engine.let_sync.set()

    class Gated(hf.Actor):
        @hf.on(Begin)
        async def begin(self, message: Begin) -> list[str]:
            await goes_on.wait()
            return [(await self.ctx.wait_for(Call)).word for _ in range(3)]

        @hf.on(Call)
        def call(self, message: Call) -> None: ...

    options: dict[str, Any] = {"store": engine, "durability": "fsync", "log": False, "intensity": 99}
    async with hf.ActorSystem("app", **options) as system:
        ref = await system.start(hf.child("patient", hf.start(Gated), recovery=hf.hybrid(interval=1000.0)))
        asked = ref.ask(Begin(), IN_TIME)
        await ref.send(Call("a"))
        async with asyncio.timeout(IN_TIME):
            while not goes_on._waiters:  # Its turn has not come so far.
                await asyncio.sleep(0.001)
        engine.let_sync.clear()
        goes_on.set()
        await asyncio.sleep(0.01)
        with system.events() as stream:
            ref.kill()
            async with asyncio.timeout(IN_TIME):
                async for event in stream:
                    if isinstance(event, hf.events.Recovered):
                        break
        engine.let_sync.set()
        for word in "bc":
            await ref.send(Call(word))
        assert await asked == ["a", "b", "c"]
        await end_of(system, "task")


async def test_a_turn_that_is_over_waits_for_nothing(tmp_path: Path) -> None:
    """With the method that replays nothing it is over when the life is."""
    async with running(tmp_path) as system:
        ref = await system.start(patient(recovery=hf.checkpoint_only()))
        asked = ref.ask(Go(["c"]), IN_TIME)
        await waits(system)
        ref.kill()
        with pytest.raises(hf.AskFailed, match="replays nothing"):
            await asked
        await ref.ask(Call("a"), IN_TIME)
        assert await ref.ask(Look(), IN_TIME) == ["no turn has waited for a"]


# -- refusals --------------------------------------------------------------------------------------------------------


class Ask(hf.Message[int]): ...


class Wrong(hf.Message[str]):
    which: int


class Strange(Patient):
    @hf.on(Wrong)
    async def wrong(self, message: Wrong) -> str:
        ctx: Any = self.ctx
        calls = [
            lambda: ctx.wait_for(),
            lambda: ctx.wait_for(int),
            lambda: ctx.wait_for(Ask),
            lambda: ctx.wait_for(Call, timeout=0),
            lambda: ctx.sleep(-1),
            lambda: ctx.sleep(float("inf")),
            lambda: ctx.sleep_until("tomorrow"),
        ]
        try:
            await calls[message.which]()
        except hf.SpecError as error:
            return str(error)
        return "nothing wrong"


@pytest.mark.parametrize(
    ("which", "says"),
    [
        (0, "classes"),
        (1, "classes"),
        (2, "Ask has another"),
        (3, "timeout"),
        (4, ">= 0"),
        (5, ">= 0"),
        (6, "Unix time"),
    ],
)
async def test_what_is_wrong_is_said_at_the_call(which: int, says: str) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(hf.child("strange", hf.start(Strange), recovery=hf.hybrid()))
        assert says in await ref.ask(Wrong(which))


async def test_where_no_home_can_hold_a_message_for_it_a_turn_does_not_wait() -> None:
    async with hf.ActorSystem("app", log=False, intensity=99) as system:
        ref = await system.start(hf.child("patient", hf.start(Patient), recovery=hf.fresh()))
        with pytest.raises(hf.RemoteCrash, match="recovery"):
            await ref.ask(Go(["c"]), IN_TIME)
        assert await ref.ask(Go(["s0.01"]), IN_TIME) == "slept"


class Starting(Patient):
    async def on_start(self, restored: bool) -> None:
        self.count += 1


@pytest.mark.parametrize("kind", [Patient, Starting])
async def test_a_start_that_does_nothing_is_not_worth_a_snapshot(tmp_path: Path, kind: type[Patient]) -> None:
    """Ten thousand turns that rest would each wait for one, when a program begins."""
    spec = hf.child("patient", hf.start(kind), recovery=hf.hybrid(interval=1000.0))
    async with running(tmp_path, "os") as system:
        (await system.start(spec)).tell(Go(["c"]))
        await waits(system)
    async with running(tmp_path, "os") as system:
        with system.events() as stream:
            ref = await system.start(spec)
            await waits(system)
            taken = [event for event in stream.take() if isinstance(event, hf.events.SnapshotTaken)]
        assert bool(taken) is (kind is Starting)
        await ref.ask(Call("a"), IN_TIME)
        assert await ref.ask(Look(), IN_TIME) == ["call a"]
