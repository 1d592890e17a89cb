"""What a replay leaves out leaves no trace: states are equal with and without (R77, T25)."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import holdfast as hf
from holdfast.checkpoint.snapshot.key_variables import state_of
from tests.checkpoint.players import Note, Notes, Sink, gate, start, until
from tests.checkpoint.strikes import NEVER, actor_of, event, home, let_through, strike, struck


class Aim(hf.Message[int]):
    """The latest for each robot counts."""

    robot: str
    at: int


class Gain(hf.Message):
    """The latest counts."""

    value: int


class Pair(hf.Message):
    """A key made of two fields, which need not be hashable."""

    a: Any
    b: Any


class Step(hf.Message[int]):
    """Looks at all of them."""


class Told(hf.Message):
    """Overwrites, but tells somebody."""

    at: int
    who: hf.ActorRef[Any]


class Aside(hf.Message[int]):
    """Put aside until the next step."""

    at: int


class Sum(hf.Message[int]): ...


class Whisper(hf.Message):
    """Looks, and tells somebody what it saw."""

    who: hf.ActorRef[Any]


class Spoil(hf.Message):
    """Is declared readonly and is not."""

    how: str


class Background(hf.Message):
    """Changes nothing by itself, but begins work whose result will."""

    gate: str


class Pilot(hf.Actor):
    def __init__(self) -> None:
        self.aims: dict[str, int] = {}
        self.gain = 1
        self.pairs: list[Any] = []
        self.told = 0
        self.position = 0
        self.way: list[int] = []
        self._handled: list[str] = []

    @hf.on(Aim, supersedes="robot")
    def aim(self, message: Aim) -> int:
        self._handled.append("aim")
        self.aims[message.robot] = message.at
        return message.at

    @hf.on(Gain, supersedes=True)
    def set_gain(self, message: Gain) -> None:
        self._handled.append("gain")
        self.gain = message.value

    @hf.on(Pair, supersedes=lambda message: (message.a, message.b))
    def pair(self, message: Pair) -> None:
        self.pairs = [message.a, message.b]

    @hf.on(Told, supersedes=True)
    def tell(self, message: Told) -> None:
        self.told = message.at
        message.who.tell(Note(str(message.at)))

    @hf.on(Step)
    def step(self, message: Step) -> int:
        self._handled.append("step")
        self.position += self.gain * sum(self.aims.values()) + self.told
        self.way.append(self.position)
        self.ctx.unstash()
        return self.position

    @hf.on(Aside)
    def aside(self, message: Aside) -> int:
        if not self.way or self.way[-1] != self.position:
            self.ctx.stash()
            return 0
        self.position += message.at
        return self.position

    @hf.on(Sum, readonly=True)
    def sum(self, message: Sum) -> int:
        self._handled.append("sum")
        return sum(self.aims.values()) + self.position

    @hf.on(Whisper, readonly=True)
    async def whisper(self, message: Whisper) -> None:
        self._handled.append("whisper")
        await message.who.ask(Note(f"w{self.position}"))

    @hf.on(Background, readonly=True)
    def background(self, message: Background) -> None:
        self.ctx.pipe_to_self(gate(message.gate), lambda _: Step())

    @hf.on(Spoil, readonly=True)
    async def spoil(self, message: Spoil) -> None:
        match message.how:
            case "gain":
                self.gain += 1
            case "deep":
                self.aims["x"] = 1
            case "stash":
                self.ctx.stash()
            case "pipe":
                self.ctx.pipe_to_self(asyncio.sleep(0.0), lambda _: Step())
            case _:
                self._cache = 1


async def pilot(system: hf.ActorSystem, isolation: str = "task", **options: Any) -> hf.ActorRef[Pilot]:
    recovery = hf.hybrid(NEVER, **options)
    return await start(system, isolation, "pilot", hf.start(Pilot), recovery=recovery)


async def skipped(system: hf.ActorSystem, ref: hf.ActorRef[Any]) -> hf.events.TurnsSkipped:
    with system.events() as stream:
        strike(system, ref)
        return await event(stream, hf.events.TurnsSkipped)


async def test_readonly_turns_are_left_out(system: hf.ActorSystem, isolation: str) -> None:
    """Those that have sent something too: it has left, and is not compared."""
    ref, notes = await pilot(system, isolation), await system.start(hf.child("sink", hf.start(Sink)))
    for n in range(3):
        await ref.ask(Aim("a", n))
        await ref.ask(Step())
        await ref.ask(Sum())
        ref.tell(Whisper(notes))
    await ref.ask(Sum())
    told = await skipped(system, ref)
    assert (told.readonly, told.superseded, told.problem) == (7, 0, "")
    assert await ref.ask(Sum()) == 2 + 3
    assert await notes.ask(Notes()) == ["w0", "w1", "w3"]
    if isolation == "task":
        assert actor_of(ref)._handled == ["aim", "step"] * 3 + ["sum"]


async def test_superseded_turns_are_left_out_if_nothing_in_between_could_have_seen_them(
    system: hf.ActorSystem, isolation: str
) -> None:
    ref = await pilot(system, isolation)
    for n in range(5):  # Only the last of each robot is wanted, and the last gain.
        ref.tell(Aim("a", n))
        ref.tell(Gain(n))
        ref.tell(Aim("b", 10 * n))
        ref.tell(Sum())
    ref.tell(Step())  # It sees them: what came before it is wanted, whatever comes behind.
    ref.tell(Aim("a", 100))
    ref.tell(Gain(2))
    assert await ref.ask(Step()) == 4 * 44 + 2 * 140
    told = await skipped(system, ref)
    assert (told.readonly, told.superseded) == (5, 12)
    assert await ref.ask(Sum()) == 140 + 4 * 44 + 2 * 140


async def test_what_has_sent_something_is_not_superseded(system: hf.ActorSystem) -> None:
    ref, notes = await pilot(system), await system.start(hf.child("sink", hf.start(Sink)))
    for n in range(3):
        ref.tell(Told(n, notes))
    ref.tell(Gain(1))
    ref.tell(Gain(2))
    await ref.ask(Step())
    assert (await skipped(system, ref)).superseded == 1
    assert await notes.ask(Notes()) == ["0", "1", "2"]


async def test_background_work_of_a_readonly_turn_is_begun_again(
    system: hf.ActorSystem, isolation: str, tmp_path: Path
) -> None:
    ref, waiting = await pilot(system, isolation), tmp_path / "gate"
    await ref.ask(Aim("a", 1))
    ref.tell(Background(str(waiting)))
    await until(waiting.exists)
    waiting.unlink()
    strike(system, ref)
    await until(waiting.exists)
    let_through(waiting)
    async with asyncio.timeout(30.0):
        while await ref.ask(Sum()) != 2:
            await asyncio.sleep(0.001)


async def test_a_key_that_cannot_be_had_leaves_nothing_out_and_is_told(system: hf.ActorSystem) -> None:
    ref = await pilot(system)
    for n in range(3):
        ref.tell(Pair([n], 1))
        ref.tell(Gain(n))
    await ref.ask(Sum())
    told = await skipped(system, ref)
    assert "unhashable" in told.problem
    assert told.superseded == 0
    assert actor_of(ref).pairs == [[2], 1]


async def test_skip_false_replays_everything(system: hf.ActorSystem) -> None:
    ref = await pilot(system, skip=False)
    for n in range(3):
        ref.tell(Gain(n))
        await ref.ask(Sum())
    recovered = await struck(system, ref)
    assert recovered.replayed == 7
    assert actor_of(ref)._handled == ["gain", "sum"] * 3


async def test_a_full_journal_gives_up_what_no_replay_needs(store: str | None) -> None:
    """A journal that only grows has room for what it does not have to keep; a root that starts anew finds it again."""
    async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
        recovery = hf.replay_only(journal_limit=20_000)
        spec = hf.child("pilot", hf.start(Pilot), recovery=recovery)
        ref = await system.start(spec)
        for n in range(1000):
            await ref.ask(Aim("a", n))
            await ref.ask(Sum())
            if n % 100 == 0:
                await ref.ask(Step())
        expected = await ref.ask(Sum())
        assert len(home(ref).turns) < 100
        for _ in range(2):
            await struck(system, ref)
            assert await ref.ask(Sum()) == expected
    if store is not None:
        async with hf.ActorSystem("app", log=False, intensity=1000, store=store) as system:
            ref = await system.start(spec)
            assert await ref.ask(Sum()) == expected


@pytest.mark.parametrize(
    ("how", "changed"),
    [("gain", "gain"), ("deep", "aims"), ("stash", "what it has stashed"), ("pipe", "what goes on in the background")],
)
async def test_a_handler_that_is_not_readonly_is_caught(
    system: hf.ActorSystem, isolation: str, how: str, changed: str
) -> None:
    ref = await pilot(system, isolation, check_readonly=True)
    await ref.ask(Aim("a", 1))
    await ref.ask(Sum())
    asked = ref.ask(Spoil("cache"))
    await asked
    with pytest.raises(hf.RemoteCrash, match=f"Spoil is declared readonly and has changed {changed}"):
        await ref.ask(Spoil(how))
    assert await ref.ask(Sum(), timeout=30.0) == 1, "the turn has failed, and left nothing"


def test_wrong_declarations_are_refused() -> None:
    with pytest.raises(TypeError, match="Gain has no such field"):
        hf.on(Gain, supersedes="robot")
    with pytest.raises(TypeError, match="writes nothing"):
        hf.on(Gain, supersedes=True, readonly=True)
    with pytest.raises(TypeError, match="is a field, a function or True"):
        hf.on(Gain, supersedes=3)  # type: ignore[arg-type]


MESSAGES = st.lists(
    st.one_of(
        st.builds(Aim, st.sampled_from("ab"), st.integers(0, 9)),
        st.builds(Gain, st.integers(0, 9)),
        st.builds(Pair, st.integers(0, 2), st.one_of(st.integers(0, 1), st.just([1]))),
        st.builds(Aside, st.integers(0, 9)),
        st.sampled_from(["told", "step", "sum", "whisper", "crash", "snapshot"]),
    ),
    max_size=30,
)


@given(messages=MESSAGES)
@settings(max_examples=60, deadline=None)
def test_replays_that_leave_out_and_that_do_not_come_to_the_same(messages: list[Any]) -> None:
    """T25: random messages, crashes and snapshots; three actors handle them, one of which never crashes."""

    async def play() -> None:
        async with hf.ActorSystem("app", log=False, intensity=1_000_000) as system:
            notes = await system.start(hf.child("sink", hf.start(Sink)))
            actors = [
                await system.start(hf.child(name, hf.start(Pilot), recovery=hf.hybrid(NEVER, skip=skip)))
                for name, skip in (("skips", True), ("replays", False), ("never", True))
            ]
            for n, message in enumerate(messages):
                for ref in actors:
                    match message:
                        case "told":
                            ref.tell(Told(n, notes))
                        case "step":
                            ref.tell(Step())
                        case "sum":
                            ref.tell(Sum())
                        case "whisper":
                            ref.tell(Whisper(notes))
                        case "crash" if ref is not actors[2]:
                            ref.kill()
                        case "crash":
                            pass
                        case "snapshot":
                            home(ref).limit._want_snapshot()
                        case _:
                            ref.tell(message)
            for ref in actors[:2]:
                await ref.ask(Sum(), timeout=20.0)
                ref.kill()
            for ref in actors:
                await ref.ask(Sum(), timeout=20.0)
            # Equal, not bit by bit: a dict may get its keys in another order when an early one is left out.
            states = [state_of(actor_of(ref)).value for ref in actors]
            assert states[0] == states[2]
            assert states[1] == states[2]

    asyncio.run(play())
