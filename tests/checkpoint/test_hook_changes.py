"""What `on_recovered` does to the state is saved before anything else is handled: no replay leads to it."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.checkpoint.snapshot.image_writer import Imaging
from holdfast.checkpoint.snapshot.state_image import IMAGE_BYTES
from holdfast.ftm.bricks.brick_messages import Done
from holdfast.ftm.group.group import Group
from tests.actors.process.waiting import next_event
from tests.checkpoint.players import until
from tests.ftm.test_failover import group_of, pid_of, two_again

IN_TIME = 25.0


class Enter(hf.Message[int]):
    """Answered with how many have entered, when the door is open."""

    tag: int


class Fall(hf.Message[None]):
    """Ends the process of whoever hears it first."""

    note: str


class Entered(hf.Message[list[int]]): ...


class Hall(hf.Actor):
    """Is closed until it has come back for the first time."""

    def __init__(self) -> None:
        self.is_open = False
        self.tags: list[int] = []

    def on_recovered(self) -> None:
        self.is_open = True
        self.ctx.unstash()

    @hf.on(Enter)
    def enter(self, message: Enter) -> int:
        if not self.is_open:
            self.ctx.stash()
            return 0
        self.tags.append(message.tag)
        return len(self.tags)

    @hf.on(Fall)
    def fall(self, message: Fall) -> None:
        if not Path(message.note).exists():
            Path(message.note).touch()
            os.kill(os.getpid(), signal.SIGKILL)

    @hf.on(Entered, readonly=True)
    def entered(self, message: Entered) -> list[int]:
        return list(self.tags)


class Grand(Hall):
    """Is so large that its snapshots are images, which come home while more is handled."""

    def __init__(self) -> None:
        super().__init__()
        self.space = bytes(2 * IMAGE_BYTES)


class Trip(hf.Message[None]):
    """Have the life end outside of any turn."""


class Stumble(hf.Message[None]):
    """A turn that raises."""


class Loose(Hall):
    """Trips, or stumbles, when it is told to."""

    @hf.on(Stumble)
    def stumble(self, message: Stumble) -> None:
        raise ValueError("stumbled")

    @hf.on(Trip)
    def trip(self, message: Trip) -> None:
        self.ctx.create_task(self._fall())

    async def _fall(self) -> None:
        raise RuntimeError("fell")


class Slow(Loose):
    """Takes its time when it comes back, and says by a file that it does."""

    def __init__(self, note: str) -> None:
        super().__init__()
        self.note = note

    async def on_recovered(self) -> None:  # type: ignore[override]  # either is called
        Path(self.note).touch()
        await asyncio.sleep(0.1)
        super().on_recovered()


class Falling(Loose):
    """Falls soon after it begins, whatever is done."""

    async def on_start(self, restored: bool) -> None:
        self.ctx.create_task(self._fall())


class Begin(hf.Message[None]):
    """Have background work begin that does not end."""


class Busy(Hall):
    """Has background work out."""

    @hf.on(Begin)
    def begin(self, message: Begin) -> None:
        self.ctx.pipe_to_self(asyncio.Event().wait(), lambda _: Entered())


class Calm(Hall):
    """Has nothing to do when it comes back."""

    def on_recovered(self) -> None: ...


PLACES: dict[str, dict[str, Any]] = {
    "task": {},
    "process": {"isolation": "process"},
    "pbr": {"mechanism": hf.ftm.PBR()},
    "lfr": {"mechanism": hf.ftm.LFR()},
    "tr": {"mechanism": hf.ftm.TR()},
    "tmr": {"mechanism": hf.ftm.TMR()},
}


async def started(system: hf.ActorSystem, place: str, kind: type[Hall] = Hall, *args: Any) -> hf.ActorRef[Any]:
    method = hf.hybrid(interval=3600.0)
    spec = hf.child("hall", hf.start(kind, *args), recovery=method, backoff=hf.Backoff(), **PLACES[place])
    ref: hf.ActorRef[Any] = await system.start(spec)
    if "mechanism" in PLACES[place]:
        await two_again(ref)
    return ref


async def is_up(system: hf.ActorSystem, ref: hf.ActorRef[Any], life: int) -> bool:
    """Whether that life, or a later one, can answer."""
    try:
        status = await system.get_status(ref, timeout=IN_TIME)
    except hf.AskFailed:  # It has ended just now.
        return False
    return status.life >= life and status.state != "recovering"


@pytest.fixture
async def system() -> Any:
    async with hf.ActorSystem("app", log=False, intensity=1000) as running:
        yield running


@pytest.mark.parametrize("place", list(PLACES))
async def test_what_a_hook_puts_back_between_two_turns_waits_for_no_message(system: hf.ActorSystem, place: str) -> None:
    ref = await started(system, place, Loose)
    first = asyncio.ensure_future(ref.ask(Enter(1), IN_TIME))
    assert await ref.ask(Entered(), IN_TIME) == []
    ref.tell(Trip())
    assert await first == 1
    assert await ref.ask(Entered(), IN_TIME) == [1]


@pytest.mark.parametrize("place", [one for one in PLACES if "mechanism" in PLACES[one]])
async def test_who_falls_again_and_again_between_two_turns_is_given_up(place: str) -> None:
    """As without a mechanism: its supervisor hears of it, and is no more able to help than to wait for ever."""
    async with hf.ActorSystem("app", log=False) as system:
        spec = hf.child("hall", hf.start(Falling), recovery=hf.hybrid(interval=3600.0), **PLACES[place])
        above = hf.supervisor("above", children=[spec], intensity=2, period=IN_TIME, restart="temporary")
        events = system.events()
        with contextlib.suppress(hf.StartFailed):
            await system.start(above)
        async with asyncio.timeout(IN_TIME):
            async for event in events:
                if isinstance(event, hf.events.SupervisorGaveUp):
                    return


@pytest.mark.parametrize("place", list(PLACES))
@pytest.mark.parametrize("is_saved", [True, False], ids=["from a snapshot", "by a replay"])
@pytest.mark.some(6)
async def test_who_dies_again_comes_back_with_what_stands_on_the_change(
    system: hf.ActorSystem, is_saved: bool, place: str
) -> None:
    """Behind a snapshot there is no replay: the state changes, and the number of the turn does not."""
    ref = await started(system, place)
    first = asyncio.ensure_future(ref.ask(Enter(1), IN_TIME))
    assert await ref.ask(Entered(), IN_TIME) == []
    if is_saved:
        await system.checkpoint(ref)
    ref.kill()
    assert await first == 1
    for tag in (2, 3, 4):
        assert await ref.ask(Enter(tag), IN_TIME) == tag
        ref.kill()
    assert await ref.ask(Entered(), IN_TIME) == [1, 2, 3, 4]


async def test_what_a_hook_leaves_of_a_large_state_does_not_wait_for_an_image(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An image comes home when more was handled; here none does."""
    monkeypatch.setattr(Imaging, "take", lambda self: None)
    ref = await started(system, "task", Grand)
    first = asyncio.ensure_future(ref.ask(Enter(1), IN_TIME))
    assert await ref.ask(Entered(), IN_TIME) == []
    ref.kill()
    assert await first == 1
    assert await ref.ask(Enter(2), IN_TIME) == 2
    ref.kill()
    assert await ref.ask(Entered(), IN_TIME) == [1, 2]


@pytest.mark.parametrize("place", [place for place in PLACES if place != "task"])
async def test_who_dies_of_the_first_message_behind_the_change_comes_back_with_it(
    system: hf.ActorSystem, tmp_path: Path, place: str
) -> None:
    """What is saved goes home before the end of the first turn does."""
    ref = await started(system, place)
    asked: list[Any] = [ref.ask(Enter(1), IN_TIME), ref.ask(Enter(2), IN_TIME)]
    ref.tell(Fall(str(tmp_path / "first")))
    asked.append(ref.ask(Enter(3), IN_TIME))
    ref.tell(Fall(str(tmp_path / "second")))
    asked.append(ref.ask(Enter(4), IN_TIME))
    assert await asyncio.gather(*asked) == [1, 2, 3, 4]
    assert await ref.ask(Entered(), IN_TIME) == [1, 2, 3, 4]


@pytest.mark.parametrize("how", ["it falls", "it falls, and is slow", "its turn fails", "its leader dies"])
async def test_replicas_that_die_before_they_say_more_than_the_first_end_come_back_with_the_change(
    system: hf.ActorSystem, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, how: str
) -> None:
    """The next life of the leader begins, and its hook changes the state before anything else is handled."""
    note = tmp_path / "note"
    ref = await (started(system, "pbr", Slow, str(note)) if "slow" in how else started(system, "pbr", Loose))
    group, take_done = group_of(ref), Group.take_done
    asked: list[Any] = [asyncio.ensure_future(ref.ask(Enter(1), IN_TIME))]
    assert await ref.ask(Entered(), IN_TIME) == []
    await system.checkpoint(ref)
    last = 2 if how == "its leader dies" else 3
    if how.startswith("it falls"):
        ref.tell(Trip())
    elif how == "its turn fails":
        ref.tell(Stumble())
    else:
        assert group.membership.primary is not None
        os.kill(pid_of(system, ref, group.membership.primary), signal.SIGKILL)
    struck: Group | None = None  # which may be the one that follows the first

    def take_and_kill(self: Group, done: Done) -> None:
        nonlocal struck
        if self is struck:
            return  # It was on its way when its sender died.
        take_done(self, done)
        if struck is None and any(end.turn > last for end in done.ends):
            struck = self
            for name in self.membership.names:
                with contextlib.suppress(KeyError):  # It is about to be started again.
                    os.kill(pid_of(system, ref, name), signal.SIGKILL)

    monkeypatch.setattr(Group, "take_done", take_and_kill)
    if "slow" in how:  # What is asked now waits for the hook.
        await until(note.exists)
    asked.append(ref.ask(Enter(2), IN_TIME))
    assert await asyncio.gather(*asked) == [1, 2]
    assert struck is not None
    assert await ref.ask(Enter(3), IN_TIME) == 3


@pytest.mark.parametrize("kind", [Hall, Calm])
async def test_a_state_that_the_hook_leaves_as_it_was_is_not_saved_again(
    system: hf.ActorSystem, kind: type[Hall]
) -> None:
    ref = await started(system, "process", kind)
    ref.kill()
    assert await ref.ask(Entered(), IN_TIME) == []
    await system.checkpoint(ref)
    with system.events() as events:
        life = (await system.get_status(ref)).life
        for _ in range(3):
            ref.kill()
            life += 1
            async with asyncio.timeout(IN_TIME):
                while not await is_up(system, ref, life):
                    await asyncio.sleep(0.005)
        assert not [one for one in events.take() if isinstance(one, hf.events.SnapshotTaken)]


class Moody(Hall):
    """Says something else when there is a file."""

    def __init__(self, note: str) -> None:
        super().__init__()
        self.note = note

    @hf.on(Enter)
    def enter(self, message: Enter) -> int:
        return message.tag + Path(self.note).exists()


@pytest.mark.parametrize("place", list(PLACES))
async def test_a_recovery_that_fails_says_that_the_replay_went_elsewhere(
    system: hf.ActorSystem, tmp_path: Path, place: str
) -> None:
    note = tmp_path / "mood"
    method = hf.hybrid(interval=3600.0)
    spec = hf.child("hall", hf.start(Moody, str(note)), recovery=method, backoff=hf.Backoff(), **PLACES[place])
    ref: hf.ActorRef[Any] = await system.start(spec)
    assert await ref.ask(Enter(1), IN_TIME) == 1
    note.touch()
    with system.events() as events:
        ref.kill()
        is_told = False
        async with asyncio.timeout(IN_TIME):
            async for one in events:
                is_told |= isinstance(one, hf.events.RecoveryFailed) and "diverged" in one.reason
                if isinstance(one, hf.events.ChildStartFailed):
                    assert is_told
                    assert "diverged" in one.reason
                    break
        note.unlink()
    assert await ref.ask(Enter(2), IN_TIME) == 2


async def test_what_a_hook_changes_while_background_work_is_out_is_not_saved(system: hf.ActorSystem) -> None:
    """A limit: a replay has begun the work again, so its turn must stay in the journal; nothing leads to the change."""
    ref = await started(system, "task", Busy)
    await ref.ask(Begin(), IN_TIME)
    ref.kill()
    assert await ref.ask(Enter(1), IN_TIME) == 1
    with system.events() as events:
        ref.kill()
        assert "diverged" in (await next_event(events, hf.events.RecoveryFailed)).reason
