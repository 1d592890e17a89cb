"""Turns that race what they wait for, and turns that give up a wait: each later life goes the same way."""

from __future__ import annotations

import asyncio
import itertools
import os
import signal
from contextvars import Context
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.checkpoint.home.input_ledger import InputLedger, outcome_entry
from holdfast.checkpoint.home.recorded_home import switch_of
from holdfast.checkpoint.home.switch import Switch
from holdfast.checkpoint.protocol import AT_ITS_END, MESSAGE, REPLY, Answer, Came, GivenUp, Out, came
from holdfast.ftm import LFR, PBR, TR
from tests.effects.clerk import IN_TIME, words
from tests.effects.racer import Both, Cancel, GiveUp, Leave, Look, Other, Race, Tire, Two, awaited, let, racer
from tests.effects.test_long_waits import end_of, running
from tests.ftm.test_failover import pid_of

PATH = "/app/racer"
WAYS = ["timeout", "wait_for", "gather", "group", "first", "at once"]
STACKS: dict[str, tuple[Any, ...]] = {"pbr": (PBR(),), "lfr": (LFR(),), "tr": (TR(),)}


async def begun(world: Path, word: str, times: int = 1) -> None:
    """Wait until an effect was begun so often."""
    async with asyncio.timeout(IN_TIME):
        while words(world / "begun").count(word.split()[0]) < times:
            await asyncio.sleep(0.001)


def wanted(system: hf.ActorSystem) -> int:
    """How many moments and messages the turn in hand waits for, as its home knows."""
    home = switch_of(system._node.cell_at(PATH))
    return 0 if home is None else len(home.calls.rests.wanted)


async def until(system: hf.ActorSystem, count: int) -> None:
    async with asyncio.timeout(IN_TIME):
        while wanted(system) != count:
            await asyncio.sleep(0.001)


async def decided(
    system: hf.ActorSystem, ref: hf.ActorRef[Any], world: Path, race: Race, first: str
) -> asyncio.Future[str]:
    """Have a race be won by the effect ("paid") or by the message, and wait until its handler has gone on."""
    asked = ref.ask(race, IN_TIME)
    await begun(world, "paid")
    await until(system, 1)
    if first == "paid":
        let(str(world), "paid")
    else:
        await ref.send(Cancel("now"))
    await begun(world, "then")
    return asked


# -- races -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("first", ["paid", "Cancel"])
@pytest.mark.parametrize(("isolation", "at_most_once"), [("task", True), ("process", False)])
async def test_a_race_is_won_by_the_same_one_again(
    tmp_path: Path, isolation: str, first: str, at_most_once: bool
) -> None:
    """Though the other one has come since, and all that is sent by either looks the same. In the next program, too."""
    world = str(tmp_path)
    async with running(tmp_path, "os") as system:
        ref = await system.start(racer(isolation))
        asked = await decided(system, ref, tmp_path, Race(world, at_most_once), first)
        assert wanted(system) == 0
        await ref.send(Cancel("late"))
        let(world, "paid")
        for end in range(2):
            await end_of(system, isolation, PATH)
            await begun(tmp_path, "then", end + 2)
        won = "paid" if first == "paid" else "Cancel(word='now')"
        let(world, f"then {won}")
        await begun(tmp_path, "end")
        await end_of(system, isolation, PATH)
        await begun(tmp_path, "end", 2)
        del asked
    async with running(tmp_path, "os") as system:
        ref = await system.start(racer(isolation))
        await begun(tmp_path, "end", 3)
        let(world, "end")
        assert await ref.ask(Look(), IN_TIME) == [won, f"then {won}", "late late"]
        assert words(tmp_path / "begun").count("paid") == 1, "what was given up is not called again"
        await end_of(system, isolation, PATH)  # The turn has ended, and is replayed.
        assert await ref.ask(Look(), IN_TIME) == [won, f"then {won}", "late late"]


@pytest.mark.parametrize("stack", STACKS)
@pytest.mark.parametrize("first", ["paid", "Cancel"])
async def test_behind_a_mechanism_too(tmp_path: Path, stack: str, first: str) -> None:
    world = str(tmp_path)
    async with running(tmp_path, "os") as system:
        ref = await system.start(racer(mechanism=STACKS[stack]))
        asked = await decided(system, ref, tmp_path, Race(world), first)
        let(world, "paid")
        await ref.send(Cancel("late"))
        os.kill(pid_of(system, ref, "r1"), signal.SIGKILL)
        won = "paid" if first == "paid" else "Cancel(word='now')"
        let(world, f"then {won}")
        let(world, "end")
        assert await asked == f"{won}, then {won}"
        assert await ref.ask(Look(), IN_TIME) == [won, f"then {won}", "late late"]


async def test_asks_that_race_come_in_the_same_order_again(tmp_path: Path) -> None:
    world = str(tmp_path)
    async with running(tmp_path, "os") as system:
        others = [await system.start(racer(name=name)) for name in ("a", "b")]
        ref = await system.start(racer())
        asked = ref.ask(Both(world, others), IN_TIME)
        await begun(tmp_path, "0")
        await begun(tmp_path, "1")
        let(world, "1")
        await begun(tmp_path, "end")
        let(world, "0")
        home = switch_of(system._node.cell_at(PATH))
        async with asyncio.timeout(IN_TIME):
            while home is None or (1, 1) not in home.ledger.outcomes:
                await asyncio.sleep(0.001)
        await end_of(system, "task", PATH)
        await begun(tmp_path, "end", 2)
        let(world, "end")
        assert await asked == "1"


async def test_an_ask_whose_answer_comes_behind_its_turn_is_not_heard_in_it(tmp_path: Path) -> None:
    world = str(tmp_path)
    async with running(tmp_path, "os") as system:
        others = [await system.start(racer(name=name)) for name in ("a", "b")]
        ref = await system.start(racer())
        asked = ref.ask(Both(world, others), IN_TIME)
        let(world, "end")
        await begun(tmp_path, "0")
        await begun(tmp_path, "1")
        let(world, "1")
        assert await asked == "1"
        let(world, "0")
        home = switch_of(system._node.cell_at(PATH))
        async with asyncio.timeout(IN_TIME):
            while home is None or (1, 1) not in home.ledger.outcomes:
                await asyncio.sleep(0.001)
        await end_of(system, "task", PATH)
        assert await ref.ask(Look(), IN_TIME) == []


async def test_what_a_turn_did_before_something_came_it_does_again(tmp_path: Path) -> None:
    """Even if nothing is recorded of what made it do so."""
    world = str(tmp_path)
    async with running(tmp_path, "os") as system:
        ref = await system.start(racer())
        asked = ref.ask(Tire(world), IN_TIME)
        await begun(tmp_path, "tired")
        let(world, "paid")
        let(world, "tired")
        await begun(tmp_path, "end")
        await end_of(system, "task", PATH)
        await begun(tmp_path, "end", 2)
        let(world, "end")
        assert await asked == "paid 0"


async def test_a_turn_that_goes_another_way_is_not_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The changed handler has one effect less, so what came behind that one would be held for ever."""
    monkeypatch.setattr("holdfast.checkpoint.life.outcome_order.PATIENCE", 0.05)
    async with running(tmp_path, "os") as system:
        ref = await system.start(racer())
        ref.tell(Two(str(tmp_path)))
        await begun(tmp_path, "two")
        let(tmp_path, "two")
        home = switch_of(system._node.cell_at(PATH))
        async with asyncio.timeout(IN_TIME):
            while home is None or (1, 2) not in home.ledger.outcomes:
                await asyncio.sleep(0.001)
        let(tmp_path, "one")
        await begun(tmp_path, "end")
        monkeypatch.setattr("tests.effects.racer.WORDS", ["one"])
        with system.events() as stream:
            ref.kill()
            async with asyncio.timeout(IN_TIME):
                async for event in stream:
                    if isinstance(event, hf.events.RecoveryFailed):
                        assert "diverged at turn 1, output 2" in str(event)
                        return


async def racing(system: hf.ActorSystem, world: Path) -> tuple[hf.ActorRef[Any], Any, Switch]:
    """A racer in the middle of its race, its answer, and its home."""
    ref = await system.start(racer())
    asked = ref.ask(Race(str(world)), IN_TIME)
    await begun(world, "paid")
    await until(system, 1)
    home = switch_of(system._node.cell_at(PATH))
    assert home is not None
    return ref, asked, home


async def test_what_comes_at_once_is_heard_one_after_another(tmp_path: Path) -> None:
    """The handler has given up the other one when that comes: the message is not lost with it."""
    world = str(tmp_path)
    async with running(tmp_path) as system:
        ref, asked, home = await racing(system, tmp_path)
        tell, told = home.calls._tell, list[tuple[int, str]]()

        def together(turn: int, k: int, answer: Any) -> None:
            tell(turn, k, answer)
            told.append((k, answer.kind))
            if len(told) == 1:
                Context().run(ref.tell, Cancel("at once"))  # By nobody: this is called in a task of the actor.

        home.calls._tell = together  # type: ignore[method-assign]  # the moment cannot be met otherwise
        let(world, "paid")
        await begun(tmp_path, "then")
        home.calls._tell = tell  # type: ignore[method-assign]
        assert told[:2] == [(1, "timed reply"), (2, "timed message")], "the message was taken for the wait"
        await end_of(system, "task", PATH)
        let(world, "then paid")
        let(world, "end")
        assert await asked == "paid, then paid"
        assert await ref.ask(Look(), IN_TIME) == ["paid", "then paid", "late at once"]


async def test_a_message_that_is_taken_as_its_wait_is_given_up_comes_behind_what_is_queued_by_then(
    tmp_path: Path,
) -> None:
    """Also behind later ones of the same sender: of the order of messages this is the exception."""
    world = str(tmp_path)
    async with running(tmp_path) as system:
        ref, asked, home = await racing(system, tmp_path)
        tell = home.calls._tell

        def together(turn: int, k: int, answer: Any) -> None:
            home.calls._tell = tell  # type: ignore[method-assign]
            tell(turn, k, answer)
            for message in (Cancel("first"), Other("second")):
                Context().run(ref.tell, message)

        home.calls._tell = together  # type: ignore[method-assign]  # the moment cannot be met otherwise
        let(world, "paid")
        await begun(tmp_path, "then")
        let(world, "then paid")
        let(world, "end")
        assert await asked == "paid, then paid"
        assert (await ref.ask(Look(), IN_TIME))[-2:] == ["other second", "late first"]


# -- giving up -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("isolation", "how"), [*(("task", how) for how in WAYS), ("process", "timeout")])
async def test_a_wait_that_was_given_up_takes_nothing(tmp_path: Path, isolation: str, how: str) -> None:
    """And neither does it in the next life; whoever waits next has the message."""
    world = str(tmp_path)
    async with running(tmp_path, "os") as system:
        ref = await system.start(racer(isolation))
        asked = ref.ask(GiveUp(world, how), IN_TIME)
        await begun(tmp_path, "again")
        await until(system, 0)
        await ref.send(Other("first"))
        await ref.send(Cancel("second"))
        await end_of(system, isolation, PATH)
        await begun(tmp_path, "again", 2)
        assert not asked.done()
        let(world, "again")
        assert await asked == "had second"
        await end_of(system, isolation, PATH)
        assert await ref.ask(Look(), IN_TIME) == ["other first"]


@pytest.mark.parametrize("stack", STACKS)
@pytest.mark.parametrize("how", ["timeout", "at once"])
async def test_nor_behind_a_mechanism(tmp_path: Path, stack: str, how: str) -> None:
    world = str(tmp_path)
    async with running(tmp_path, "os") as system:
        ref = await system.start(racer(mechanism=STACKS[stack]))
        asked = ref.ask(GiveUp(world, how), IN_TIME)
        await begun(tmp_path, "again")
        await until(system, 0)
        await ref.send(Cancel("second"))
        let(world, "again")
        assert await asked == "had second"


async def test_nor_if_its_home_did_not_hear_of_that(tmp_path: Path) -> None:
    """As when the leader has died with it: whoever leads now has the wait begin, and gives it up again."""
    world = str(tmp_path)
    async with running(tmp_path) as system:
        ref = await system.start(racer())
        home = switch_of(system._node.cell_at(PATH))
        assert home is not None
        give_up, lost = home.calls.give_up, list[GivenUp]()

        def lose_first(record: GivenUp) -> None:
            if lost:
                give_up(record)
            else:
                lost.append(record)

        home.calls.give_up = lose_first  # type: ignore[method-assign]  # one process has nobody who could lose it
        asked = ref.ask(GiveUp(world, "at once"), IN_TIME)
        await begun(tmp_path, "again")
        await until(system, 1)
        await ref.send(Cancel("second"))
        let(world, "again")
        assert await asked == "had second"


@pytest.mark.parametrize("stack", [None, *STACKS])
async def test_a_turn_that_ends_waits_for_nothing_any_more(tmp_path: Path, stack: str | None) -> None:
    async with running(tmp_path, "os") as system:
        ref = await system.start(racer(mechanism=None if stack is None else STACKS[stack]))
        left = [ref.ask(Leave(), IN_TIME) for _ in range(3)]
        assert await asyncio.gather(*left) == ["left"] * 3
        await ref.ask(Cancel("then"), IN_TIME)
        assert await ref.ask(Look(), IN_TIME) == ["late then"]


async def test_a_killed_turn_has_given_up_nothing(tmp_path: Path) -> None:
    """Its waits are cancelled from outside: the next life waits on."""
    world = str(tmp_path)
    async with running(tmp_path, "os") as system:
        ref = await system.start(racer())
        asked = ref.ask(Race(world), IN_TIME)
        await until(system, 1)
        await end_of(system, "task", PATH)
        await until(system, 1)
        await ref.send(Cancel("now"))
        let(world, "then Cancel(word='now')")
        let(world, "end")
        assert await asked == "Cancel(word='now'), then Cancel(word='now')"


class Wait(hf.Message[str]):
    """Wait for a Cancel, a moment and an effect, in one of several ways."""

    how: str


class Waiter(hf.Actor):
    @hf.on(Cancel)
    def cancel(self, message: Cancel) -> None: ...

    @hf.on(Wait)
    async def wait(self, message: Wait) -> str:
        match message.how:
            case "effect":
                return await self.ctx.effect(quickly)
            case "message":
                return (await self.ctx.wait_for(Cancel)).word
            case "group":
                async with asyncio.TaskGroup() as group:
                    tasks = [group.create_task(awaited(one)) for one in (self.ctx.effect(quickly), self.ctx.sleep(0.1))]
                return str(tasks[0].result())
            case _:
                return str((await asyncio.gather(self.ctx.effect(quickly), self.ctx.sleep(0.1)))[0])


async def quickly() -> str:
    return "done"


@pytest.mark.asyncio(loop_factories=["virtual"])
@pytest.mark.parametrize("how", ["effect", "message", "group", "gather"])
async def test_a_turn_is_killed_at_any_step_of_the_loop_and_goes_on(tmp_path: Path, how: str) -> None:
    async with running(tmp_path) as system:
        for steps in range(12):
            ref = await system.start(hf.child(f"w{steps}", hf.start(Waiter), recovery=hf.hybrid(interval=1000.0)))
            asked = ref.ask(Wait(how), IN_TIME)
            for _ in range(steps):
                await asyncio.sleep(0)
            ref.kill()
            if how == "message":
                await ref.send(Cancel("done"))
            assert await asked == "done", f"killed after {steps} steps"


class Gate(hf.Actor):
    """Waits for an effect and a message at once; they come at once, too."""

    may_go = asyncio.Event()

    @hf.on(Cancel)
    def cancel(self, message: Cancel) -> None: ...

    @hf.on(Wait)
    async def wait(self, message: Wait) -> str:
        both: list[asyncio.Future[Any]] = [self.ctx.effect(self.pass_by), self.ctx.wait_for(Cancel)]
        if message.how == "gather":
            return str(await asyncio.gather(*both))
        async with asyncio.TaskGroup() as group:
            for one in both:
                group.create_task(awaited(one))
        return str([one.result() for one in both])

    @classmethod
    async def pass_by(cls) -> str:
        await cls.may_go.wait()
        return "passed"


@pytest.mark.asyncio(loop_factories=["virtual"])
@pytest.mark.parametrize("how", ["group", "gather"])
async def test_what_comes_while_a_turn_is_being_killed_comes_again(tmp_path: Path, how: str) -> None:
    async with running(tmp_path) as system:
        for between, steps in itertools.product(range(4), range(9)):
            Gate.may_go = asyncio.Event()
            spec = hf.child(f"g{between}{steps}", hf.start(Gate), recovery=hf.hybrid(interval=1000.0))
            ref = await system.start(spec)
            asked = ref.ask(Wait(how), IN_TIME)
            await asyncio.sleep(1.0)
            Gate.may_go.set()
            for _ in range(between):
                await asyncio.sleep(0)
            ref.tell(Cancel("now"))
            for _ in range(steps):
                await asyncio.sleep(0)
            ref.kill()
            assert await asked == "['passed', Cancel(word='now')]", f"{steps} steps behind {between}"


# -- the record ------------------------------------------------------------------------------------------------------


def same(out: Out, digest: int) -> bool:
    return False


def test_outcomes_have_their_places_in_the_journal() -> None:
    ledger = InputLedger("/app/a")
    source = ledger.admit(MESSAGE, "m:Do", b"", 0.0, None)
    entries: list[Any] = [source.entry()]
    for k, count in ((2, 2), (1, 3)):
        for number in range(len(ledger.released) + 1, count + 1):
            ledger.compare_outputs(0, source.id, [Out(number, "effect", "x")], same)
        entries.append(ledger.released_entry(0))
        kept = ledger.note_outcome(0, k, Answer(REPLY))
        assert kept is not None
        assert kept == Came(REPLY, "", b"", 3 - k, count)
        entries.append(outcome_entry(0, k, kept))
    entries.append(outcome_entry(0, 3, came(Answer(REPLY), AT_ITS_END)))  # By somebody who did not know the others.
    for _ in range(2):
        ledger = InputLedger("/app/a")
        for position, entry in enumerate(entries):
            assert ledger.read_entry(position, entry)
        assert ledger.outcomes == {
            (0, 2): Came(REPLY, "", b"", 1, 2),
            (0, 1): Came(REPLY, "", b"", 2, 3),
            (0, 3): Came(REPLY, "", b"", 3, 3),
        }
        entries = ledger.entries()
    kept = ledger.note_outcome(0, 4, Answer(REPLY))
    assert kept is not None
    assert kept.nth == 4


def test_what_is_read_of_an_earlier_version_has_no_place() -> None:
    ledger = InputLedger("/app/a")
    for entry in (InputLedger("").admit(MESSAGE, "m:Do", b"", 0.0, None).entry(), ("got", 0, 1, REPLY, "", b"")):
        assert ledger.read_entry(0, entry)
    assert ledger.outcomes == {(0, 1): Came(REPLY)}
