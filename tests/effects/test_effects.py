"""Effects of recorded actors: made once, with an outcome that every replay gets; what a crash in between means."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import threading
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.values import encode_value
from holdfast.checkpoint.home.recorded_home import switch_of
from holdfast.checkpoint.protocol import REPLY, Answer, Performed
from tests.checkpoint.players import start
from tests.checkpoint.test_commits import Slow
from tests.effects.clerk import IN_TIME, Clerk, Do, Done, No, clerk, deed, lines, words


@pytest.fixture
def world(tmp_path: Path) -> str:
    return str(tmp_path / "world")


def running(tmp_path: Path, durability: str) -> hf.ActorSystem:
    store = None if durability == "memory" else f"sqlite:{tmp_path / 'app.db'}"
    return hf.ActorSystem("app", log=False, store=store, intensity=99)


async def crash(system: hf.ActorSystem) -> None:
    """End the life between two turns, and wait until the next one is there."""
    with system.events() as stream:
        system.ref("/app/clerk", Clerk).kill()
        async with asyncio.timeout(IN_TIME):
            async for event in stream:
                if isinstance(event, hf.events.Recovered):
                    return


@pytest.mark.parametrize("durability", ["memory", "os"])
@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_replay_gets_the_outcome_and_makes_no_effect(
    tmp_path: Path, world: str, isolation: str, durability: str
) -> None:
    """A result, one of a thread, a refusal, a failure, success at a later attempt, what cannot be kept."""
    asked = ["a", "thread", "b:no", "c:raise9", "d:raise2", "e:slow", "f:unsavable"]
    async with running(tmp_path, durability) as system:
        ref = await system.start(clerk(isolation))
        said = await ref.ask(Do(world, asked), IN_TIME)
        assert "a! thread! (No(why='b'))" in said
        assert "has failed at attempt 3: ConnectionError: no line to c" in said
        assert "d! e!" in said
        assert "cannot be saved" in said
        made = words(world)
        assert made == ["a", "thread", "b", "c", "c", "c", "d", "d", "d", "e", "e", "f"]
        for _ in range(2):
            await crash(system)
            assert await ref.ask(Done(), IN_TIME) == [said]
        assert words(world) == made
    if durability == "os":
        async with running(tmp_path, durability) as system:
            ref = await system.start(clerk(isolation))
            assert await ref.ask(Done(), IN_TIME) == [said]
            assert words(world) == made


@pytest.mark.parametrize("durability", ["memory", "os"])
@pytest.mark.parametrize("at", [0, 1, 2])
async def test_what_was_made_before_the_crash_is_not_made_again(
    tmp_path: Path, world: str, durability: str, at: int
) -> None:
    async with running(tmp_path, durability) as system:
        ref = await system.start(clerk())
        assert await ref.ask(Do(world, ["a", "thread", "c"], dies_after=at), IN_TIME) == "a! thread! c!"
        assert words(world) == ["a", "thread", "c"]
        assert await ref.ask(Done(), IN_TIME) == ["a! thread! c!"]


async def test_an_effect_that_was_out_is_made_again_with_the_same_key(tmp_path: Path, world: str) -> None:
    async with running(tmp_path, "memory") as system:
        ref = await system.start(clerk())
        with system.events() as stream:
            assert await ref.ask(Do(world, ["a", "b:die", "c"]), IN_TIME) == "a! b! c!"
            told = stream.take()
        assert words(world) == ["a", "b", "b", "c"]
        assert len({line.split()[1] for line in lines(world)}) == 1
        again = [event for event in told if isinstance(event, hf.events.EffectRepeated)]
        assert [(event.address, event.effect, event.message) for event in again] == [
            ("/app/clerk", "deed", "tests.effects.clerk:Do")
        ]


async def test_one_that_is_made_at_most_once_is_in_doubt(tmp_path: Path, world: str) -> None:
    """So it is in each later replay, too."""
    async with running(tmp_path, "os") as system:
        ref = await system.start(clerk())
        said = await ref.ask(Do(world, ["a", "once:die", "c"]), IN_TIME)
        assert said.startswith("a! (/app/clerk has ended while its effect deed was out")
        for _ in range(2):
            await crash(system)
            assert await ref.ask(Done(), IN_TIME) == [said]
    async with running(tmp_path, "os") as system:
        ref = await system.start(clerk())
        assert await ref.ask(Done(), IN_TIME) == [said]
        assert words(world) == ["a", "once", "c"]


async def test_each_message_has_a_key_of_its_own_whatever_becomes_of_the_store(tmp_path: Path, world: str) -> None:
    for number in range(2):
        async with running(tmp_path / str(number), "memory") as system:
            ref = await system.start(clerk("task"))
            other = await system.start(hf.child("other", hf.start(Clerk), recovery=hf.hybrid()))
            for one in (ref, other, ref):
                await one.ask(Do(world, ["a"]))
    keys = [line.split()[1] for line in lines(world)]
    assert len(keys) == len(set(keys)) == 6


@pytest.mark.parametrize("method", [hf.hybrid, hf.replay_only])
async def test_the_interrupted_turn_goes_on(tmp_path: Path, world: str, method: Any) -> None:
    async with running(tmp_path, "memory") as system:
        ref = await system.start(clerk(recovery=method()))
        assert await ref.ask(Do(world, ["a", "b"], dies_after=0), IN_TIME) == "a! b!"
        assert words(world) == ["a", "b"]


async def test_where_nothing_is_replayed_the_interrupted_turn_is_over(tmp_path: Path, world: str) -> None:
    async with running(tmp_path, "memory") as system:
        ref = await system.start(clerk(recovery=hf.checkpoint_only()))
        with pytest.raises(hf.AskFailed, match="replays nothing"):
            await ref.ask(Do(world, ["a", "b"], dies_after=0), IN_TIME)
        assert words(world) == ["a"]


class Task(hf.Message[str]):
    verb: str


class Scattering(hf.Actor):
    @hf.on(Task)
    async def scatter(self, message: Task) -> str:
        async def one() -> None:
            await (self.ctx.effect(int, "3") if message.verb == "effect" else self.ctx.sleep(0.0))

        try:
            await asyncio.gather(one())
        except hf.HoldfastError as error:
            return str(error)
        return "done"


@pytest.mark.parametrize("verb", ["effect", "sleep"])
async def test_a_task_beside_the_turn_has_none(verb: str) -> None:
    """No replay could repeat it: to make it without a record would be worse than to refuse."""
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(hf.child("scattering", hf.start(Scattering), recovery=hf.hybrid()))
        assert "nor use ctx.effect or ctx.sleep" in await ref.ask(Task(verb))


async def test_without_recovery_it_is_made_and_there_is_no_key(world: str) -> None:
    class Plain(hf.Actor):
        @hf.on(Do)
        async def do(self, message: Do) -> str:
            with pytest.raises(hf.HoldfastError, match="recovery"):
                self.ctx.message_id  # noqa: B018  # it raises
            with pytest.raises(hf.errors.EffectFailed, match=r"attempt 1: ValueError: invalid literal"):
                await self.ctx.effect(int, "x")
            return await self.ctx.effect(str.upper, "a")

    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(hf.child("plain", hf.start(Plain)))
        assert await ref.ask(Do(world, [])) == "A"


class Wrong(hf.Message[str]):
    which: int


class Strange(hf.Actor):
    @hf.on(Wrong)
    async def wrong(self, message: Wrong) -> str:
        effect: Any = self.ctx.effect
        calls: list[tuple[tuple[Any, ...], dict[str, Any]]] = [
            ((3,), {}),
            ((str,), {"timeout": 0}),
            ((str,), {"timeout": float("nan")}),
            ((str,), {"timeout": True}),
            ((str,), {"retry": 3}),
            ((str,), {"key": 3}),
            ((str,), {"key": "a file \udcff"}),
            ((str,), {"at_most_once": True, "retry": hf.Retry()}),
        ]
        args, options = calls[message.which]
        try:
            await effect(*args, **options)
        except hf.SpecError as error:
            return str(error)
        return "nothing wrong"


@pytest.mark.parametrize(
    ("which", "says"),
    list(enumerate(["function", "timeout", "timeout", "timeout", "retry", "key", "key", "at most once"])),
)
@pytest.mark.parametrize("recovery", [hf.fresh(), hf.hybrid()])
async def test_what_is_wrong_is_said_at_the_call(recovery: Any, which: int, says: str) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(hf.child("strange", hf.start(Strange), recovery=recovery))
        assert says in await ref.ask(Wrong(which))


@pytest.mark.parametrize(
    "options", [{"attempts": 0}, {"attempts": True}, {"backoff": 1.0}, {"on": ValueError}, {"on": (3,)}]
)
def test_a_wrong_retry_is_refused(options: dict[str, Any]) -> None:
    with pytest.raises(hf.SpecError, match=next(iter(options))):
        hf.Retry(**options)


class Sneak(hf.Message[str]):
    is_async: bool


class Sneaky(hf.Actor):
    """What its effect tells the actor would be no part of any turn."""

    def __init__(self) -> None:
        self.told = 0

    @hf.on(Sneak)
    async def sneak(self, message: Sneak) -> str:
        def tell() -> None:
            self.ctx.ref.tell(Done())

        async def tell_async() -> None:
            tell()

        try:
            await self.ctx.effect(tell_async if message.is_async else tell)
        except hf.HoldfastError as error:
            return str(error)
        return "told"

    @hf.on(Done)
    def done(self, message: Done) -> list[str]:
        self.told += 1
        return [str(self.told)]


@pytest.mark.parametrize("is_async", [True, False])
@pytest.mark.parametrize("place", ["task", "process", "subtree", "PBR", "LFR", "TR"])
async def test_an_effect_may_not_send_in_the_name_of_the_actor(place: str, is_async: bool) -> None:
    """Wherever the actor lives, on the loop and in a thread: a replay, which makes no effect, would send nothing."""
    options: Any = {"recovery": hf.hybrid(interval=1000.0)}
    if hasattr(hf.ftm, place):
        place, options["mechanism"] = "task", getattr(hf.ftm, place)()
    async with hf.ActorSystem("app", log=False) as system:
        ref = await start(system, place, "sneaky", hf.start(Sneaky), **options)
        assert "may not send" in await ref.ask(Sneak(is_async), IN_TIME)
        assert await ref.ask(Done(), IN_TIME) == ["1"]
        ref.kill()
        assert await ref.ask(Done(), IN_TIME) == ["2"]


class Gather(hf.Message[list[str]]):
    file: str
    count: int
    dies: bool = False


class Gathering(Clerk):
    @hf.on(Gather)
    async def gather(self, message: Gather) -> list[str]:
        works = [self.effect(message.file, f"a{number}") for number in range(message.count)]
        said = await asyncio.gather(*works)
        if message.dies and self.ctx.life == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return said


async def test_many_at_once_are_each_made_once(tmp_path: Path, world: str) -> None:
    async with running(tmp_path, "os") as system:
        ref = await system.start(
            hf.child("clerk", hf.start(Gathering), isolation="process", recovery=hf.hybrid(interval=1000.0))
        )
        said = await ref.ask(Gather(world, 50, dies=True), IN_TIME)
        assert said == [f"a{number}!" for number in range(50)]
        assert sorted(words(world)) == sorted(f"a{number}" for number in range(50))


class Begin(hf.Message[int]): ...


async def test_an_effect_waits_until_all_before_it_is_safe(tmp_path: Path) -> None:
    engine, goes_on, made = Slow(tmp_path / "app.db"), asyncio.Event(), list[str]()
    engine.let_sync.set()

    async def make() -> int:
        made.append("made")
        return 1

    class Careful(hf.Actor):
        @hf.on(Begin)
        async def begin(self, message: Begin) -> int:
            await goes_on.wait()
            return await self.ctx.effect(make)

    options: dict[str, Any] = {"store": engine, "durability": "fsync", "log": False}
    async with hf.ActorSystem("app", **options) as system:
        ref = await system.start(hf.child("careful", hf.start(Careful), recovery=hf.hybrid(interval=1000.0)))
        asked = ref.ask(Begin(), IN_TIME)
        async with asyncio.timeout(IN_TIME):
            while not goes_on._waiters:  # Its turn has not come so far.
                await asyncio.sleep(0.001)
        engine.let_sync.clear()  # From here on nothing becomes safe.
        goes_on.set()
        done, _ = await asyncio.wait([asked], timeout=0.2)
        assert (done, made) == (set(), [])
        engine.let_sync.set()
        assert await asked == 1
        assert made == ["made"]


class Hours(hf.Message[float]): ...


class Late(hf.Actor):
    @hf.on(Hours)
    async def late(self, message: Hours) -> float:
        begin = self.ctx.now()
        for how in ("passes", "fails", "refuses"):
            with contextlib.suppress(hf.HoldfastError):
                await self.ctx.effect(an_hour, how)
        await self.ctx.sleep(3600.0)
        return self.ctx.now() - begin


async def an_hour(how: str) -> None:
    await asyncio.sleep(3600.0)
    if how == "fails":
        raise ConnectionError
    if how == "refuses":
        raise No("not today")


@pytest.mark.asyncio(loop_factories=["virtual"])
async def test_the_clock_of_a_turn_moves_on_whatever_its_effects_come_to() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(hf.child("late", hf.start(Late), recovery=hf.hybrid(interval=1e6)))
        assert await ref.ask(Hours(), 5 * 3600.0) == pytest.approx(4 * 3600.0, abs=1.0)


class Leave(hf.Message[int]):
    file: str


class Leaving(Clerk):
    @hf.on(Leave)
    async def leave(self, message: Leave) -> int:
        left = self.ctx.effect(deed, message.file, "left:slow", self.ctx.message_id)
        await self.ctx.effect(deed, message.file, "other", self.ctx.message_id)
        left.cancel()
        return 1


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_what_a_turn_has_left_without_an_outcome_is_not_made_by_its_replay(
    tmp_path: Path, world: str, isolation: Any
) -> None:
    async with running(tmp_path, "memory") as system:
        spec = hf.child("clerk", hf.start(Leaving), isolation=isolation, recovery=hf.hybrid(interval=1000.0))
        ref = await system.start(spec)
        assert await ref.ask(Leave(world), IN_TIME) == 1
        await crash(system)
        assert await ref.ask(Done(), IN_TIME) == []
    assert words(world) == ["left", "other"]


async def test_an_effect_ends_when_its_handler_does_not_wait_any_more() -> None:
    ends = asyncio.Event()

    async def endless() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            ends.set()

    class Hasty(hf.Actor):
        @hf.on(Begin)
        async def begin(self, message: Begin) -> int:
            effect = self.ctx.effect(endless)
            await self.ctx.sleep(0.01)
            effect.cancel()
            return 1

    async with hf.ActorSystem("app", log=False) as system:
        ref = await system.start(hf.child("hasty", hf.start(Hasty), recovery=hf.hybrid(interval=1000.0)))
        assert await ref.ask(Begin(), IN_TIME) == 1
        await asyncio.wait_for(ends.wait(), IN_TIME)


class Rotten(BaseException):
    def __str__(self) -> str:
        raise KeyboardInterrupt


class Locked(hf.Refusal):
    what: object


RAISED: dict[str, tuple[Any, str]] = {
    "exit": (lambda: SystemExit(3), "SystemExit: 3"),
    "interrupt": (lambda: KeyboardInterrupt(), "KeyboardInterrupt"),
    "cancelled": (lambda: asyncio.CancelledError("inside"), "CancelledError: inside"),
    "generator exit": (lambda: GeneratorExit(), "GeneratorExit"),
    "base": (lambda: BaseException("base"), "BaseException: base"),
    "group": (lambda: BaseExceptionGroup("two", [SystemExit(), ValueError()]), "BaseExceptionGroup: two"),
    "no text": (lambda: Rotten(), "Rotten: <its text cannot be shown: KeyboardInterrupt>"),
    "no refusal": (lambda: Locked(threading.Lock()), "what it has raised cannot be kept"),
    "stop": (lambda: StopIteration(3), "StopIteration"),
    "too large": (None, "too large to leave its process"),
}


def explode(name: str) -> bytes:
    """Raise that, or return too much for one frame."""
    made = RAISED[name][0]
    if made is None:
        return bytes(200_000_000)
    raise made()


async def explode_async(name: str) -> bytes:
    """The same, awaited."""
    return explode(name)


class Explode(hf.Message[str]):
    name: str
    is_async: bool


class Exploding(Clerk):
    @hf.on(Explode)
    async def explode(self, message: Explode) -> str:
        try:
            if message.is_async:
                value = await self.ctx.effect(explode_async, message.name)
            else:
                value = await self.ctx.effect(explode, message.name)
        except hf.HoldfastError as error:
            return str(error)
        return f"{len(value)} bytes"


@pytest.mark.pairs
@pytest.mark.parametrize("is_async", [True, False])
@pytest.mark.parametrize("isolation", ["task", "process"])
@pytest.mark.parametrize("name", RAISED)
async def test_whatever_an_effect_raises_is_its_outcome(name: str, isolation: Any, is_async: bool) -> None:
    """The turn gets it, and neither hangs nor ends its actor; nor does the program end."""
    async with hf.ActorSystem("app", log=False) as system:
        spec = hf.child("clerk", hf.start(Exploding), isolation=isolation, recovery=hf.hybrid(interval=1000.0))
        ref = await system.start(spec)
        with system.events() as stream:
            said = await ref.ask(Explode(name, is_async), IN_TIME)
            if (name, isolation) == ("too large", "task"):
                assert said == "200000000 bytes"
            else:
                assert RAISED[name][1] in said
            assert await ref.ask(Done(), IN_TIME) == []
            assert not [event for event in stream.take() if isinstance(event, hf.events.ActorCrashed)]


async def cancel_itself() -> None:
    """As a library does that takes the task of the effect for its own."""
    task = asyncio.current_task()
    assert task is not None
    task.cancel()
    await asyncio.sleep(0)


class Cancelling(Clerk):
    @hf.on(Begin)
    async def begin(self, message: Begin) -> int:
        with pytest.raises(hf.errors.EffectFailed, match="CancelledError"):
            await self.ctx.effect(cancel_itself)
        return 1


@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_an_effect_that_cancels_its_own_task_has_failed(isolation: Any) -> None:
    """Nobody else wants it to end, and the turn waits for an outcome."""
    async with hf.ActorSystem("app", log=False) as system:
        spec = hf.child("clerk", hf.start(Cancelling), isolation=isolation, recovery=hf.hybrid(interval=1000.0))
        ref = await system.start(spec)
        assert await ref.ask(Begin(), IN_TIME) == 1


async def test_what_nobody_has_ordered_is_no_outcome(tmp_path: Path, world: str) -> None:
    """A process says so, of a turn that is over and of one that is not there: its journal takes none of it."""
    async with running(tmp_path, "memory") as system:
        ref = await system.start(clerk())
        await ref.ask(Do(world, ["a"]), IN_TIME)
        home = switch_of(system._node.cell_at(ref.path))
        assert home is not None
        before = dict(home.ledger.outcomes)
        for turn in (0, home.turn, home.turn + 1):
            home.calls.performed(Performed(turn, 1, Answer(REPLY, "", encode_value("forged"))))
        assert home.ledger.outcomes == before
