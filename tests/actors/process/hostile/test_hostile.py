"""A compromised worker that writes frames itself: the root lives, all others go on, it is ended, told of, replaced."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import msgspec
import pytest

import holdfast as hf
from holdfast.actors.process.wire import frames as f
from holdfast.checkpoint.protocol import Live, Out, Released, Snapshot
from holdfast.testing import probe
from tests.actors.process.hostile.conftest import World
from tests.actors.process.hostile.forging import BREACHES, EVIL, HARMLESS, SUP, VICTIM, command, frame, note, raw, tell
from tests.actors.process.hostile.players import Add, BeDeaf, Evil, Ping, SetPage, Victim, Write, WriteLater
from tests.actors.process.waiting import next_event, until

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")


async def test_a_breach_ends_the_worker_and_nobody_else(world: World) -> None:
    for name, make in BREACHES.items():
        world.trying(name)
        with world.system.events() as events:
            await world.write(make())
            await world.breached(events)
        await world.judge()


async def test_what_is_only_nonsense_is_refused(world: World) -> None:
    pid = world.system.pid_of(world.evil)
    for name, make in HARMLESS.items():
        world.trying(name)
        await world.write(make())
        assert await world.evil.ask(Ping(), timeout=60) == 1  # Its answer comes behind what it has written.
        await world.judge()
        assert world.system.pid_of(world.evil) == pid, name


async def test_the_event_says_what_was_tried(world: World) -> None:
    with world.system.events() as events:
        await world.write(command(VICTIM, "kill"))
        breach = await world.breached(events)
    assert breach.problem == f"'kill' to {VICTIM}, which {EVIL} has neither started nor is bound to"
    with world.system.events() as events:
        await world.write(tell([], sender=SUP))
        assert (await world.breached(events)).problem == f"a message of {SUP}, and the process is that of {EVIL}"


async def test_askers_monitors_rules_and_the_log_get_the_reason(caplog: pytest.LogCaptureFixture) -> None:
    said = f"breach of trust: 'kill' to {VICTIM}, which /app/evil has neither started nor is bound to"
    rules = [hf.rule(hf.TrustBreach, "stop")]
    async with hf.ActorSystem("app", log=True) as system:
        evil = await system.start(hf.child("evil", hf.start(Evil), isolation="process", rules=rules))
        watcher = probe(system)
        watcher.monitor(evil)
        with pytest.raises(hf.AskFailed, match=re.escape(said)):
            await evil.ask(Write(command(VICTIM, "kill")), timeout=60)
        down = await watcher.expect_down(evil, hf.TrustBreach)
        assert str(down.reason) == said
        with pytest.raises(hf.ActorStopped):
            await evil.ask(Ping())
    assert [one.getMessage() for one in caplog.records if said in one.getMessage()]


@pytest.mark.parametrize("place", [0, 1])
@pytest.mark.parametrize("number", [2**62, 2**64 - 1, 1000])
async def test_a_number_on_the_page_that_cannot_be(place: int, number: int) -> None:
    """With a bounded mailbox the root counts by it."""
    async with hf.ActorSystem("app", log=False, intensity=1000) as system:
        bounded = {"isolation": "process", "mailbox": hf.bounded(10)}
        evil = await system.start(hf.child("evil", hf.start(Evil), **bounded))  # type: ignore[arg-type]
        victim = await system.start(hf.child("victim", hf.start(Victim)))
        with system.events() as events:
            evil.tell(SetPage(place, number, frame(f.PageChanged())))
            assert (await next_event(events, hf.events.TrustBreached)).address == "/app/evil"
            await next_event(events, hf.events.ActorStarted, lambda event: event.address == "/app/evil")
        assert await victim.ask(Add()) == 1
        assert await evil.ask(Ping(), timeout=60) == 1


async def test_a_flood_does_not_starve_the_others(world: World) -> None:
    """While one process writes without end, the others are served, and the root can still end it."""
    piece = frame(*[f.Tell(VICTIM, "x:Y", raw([]))], *[f.Tell(0, 1, raw([]))] * 5000)
    again = frame(*[f.Tell(0, 1, raw([]))] * 5000)
    await world.write(piece)
    assert await world.evil.ask(WriteLater(again, 200), timeout=60) == 1
    for _ in range(20):
        await world.work()
    world.evil.kill()
    await world.judge()


async def test_who_does_not_read_is_not_listened_to(world: World) -> None:
    """A process that asks and never reads its answers does not fill the root's memory with them."""
    await world.system.start(hf.child("echo", hf.start(Echo), restart="temporary"))
    cell = world.evil._cell
    connection = world.system._workers.by_cell[cell].connection
    name = "tests.actors.process.hostile.test_hostile:Large"
    asks = frame(f.Ask(1, "/app/echo", name, raw([1 << 20]), 1e18)) + frame(
        *[f.Ask(at, 0, 1, raw([1 << 20]), 1e18) for at in range(2, 2000)]
    )
    assert await world.evil.ask(BeDeaf(), timeout=60) == 1
    await world.write(asks)
    await until(lambda: connection.room() is not None)
    for _ in range(20):
        await world.work()
    world.evil.kill()
    await world.system.terminate(world.system.ref("/app/echo", Echo))
    await world.judge()


class Large(hf.Message[bytes]):
    size: int


class Echo(hf.Actor):
    @hf.on(Large)
    def large(self, message: Large) -> bytes:
        return bytes(message.size)


async def test_an_error_that_cannot_be_made_is_an_error(world: World) -> None:
    """The failure of an ask is made of what the process says; whatever that is, the asker gets an error."""
    worker = world.system._workers.by_cell[world.evil._cell]
    failures = [
        ("error", "holdfast.actors.errors.AskTimeout", [1]),
        ("error", "holdfast.actors.errors.MailboxFull", []),
        ("crash", "", [1, 2, 3, 4, 5, 6]),
        ("refusal", "x", 5),
        ("nothing", "", []),
    ]
    for kind, name, body in failures:
        asked = world.evil.ask(Write(b""), timeout=60)
        await asked
        key = worker._last_id + 1
        failing = world.evil.ask(Write(frame(f.Failure(key, kind, name, raw(body)))), timeout=60)
        with pytest.raises(hf.HoldfastError):
            await failing
    await world.judge()


async def test_a_dead_letter_for_another_says_who_tells_it(world: World) -> None:
    with world.system.events() as events:
        await world.write(note("DeadLetter", address=VICTIM, message="m", why="none \x1b[2J", sender=""))
        letter = await next_event(events, hf.events.DeadLetter)
    assert (letter.address, letter.why) == (VICTIM, f"none ?[2J (told by {EVIL})")


def test_every_kind_of_frame_is_tried() -> None:
    """The suite writes each kind that there is."""
    assert {type(one) for one in _frames()} >= set(f.Frame.__subclasses__())


def _frames() -> list[f.Frame]:
    decoder = msgspec.msgpack.Decoder(f.AnyFrame)
    found: list[f.Frame] = []
    for make in (*BREACHES.values(), *HARMLESS.values()):
        data = make()
        while len(data) > 4:
            size = int.from_bytes(data[:4], "little")
            try:
                found.append(decoder.decode(data[4 : 4 + size]) if size < 10_000 else f.Beat())
            except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
                break
            data = data[4 + size :]
    return found


async def test_a_signal_that_says_it_was_carried_behind_a_move_ends_nobody(world: World) -> None:
    """The root may say so to a process, of a tie that is over; a process is not believed."""
    crash = {"exit": "Crash", "type_name": "Boom", "text": "boom"}
    victim = world.system.ref(VICTIM, Victim)
    life = victim._cell.life
    await world.write(
        command(VICTIM, "exit", source=EVIL, reason=crash, carried=True)
        + command(VICTIM, "down", source=EVIL, reason=crash, recovering=False, for_good=False, carried=True)
    )
    for _ in range(2):
        await world.judge()
    assert victim._cell.life == life


OUT = Out(1, "timer", "x", seconds=1.0)
ENDLESS: dict[str, Callable[[float], object]] = {
    "a delay": lambda number: Released(1, 1, [msgspec.structs.replace(OUT, seconds=number)]),
    "an interval": lambda number: Released(1, 1, [msgspec.structs.replace(OUT, interval=number)]),
    "a restore": Live,
    "a snapshot": lambda number: Snapshot(1, b"", False, [], number),
}


@pytest.mark.parametrize("number", [float("inf"), float("-inf"), float("nan")])
@pytest.mark.parametrize("what", ENDLESS)
async def test_numbers_of_a_recorded_life_that_are_none_are_a_breach(what: str, number: float) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        other = await system.start(hf.child("other", hf.start(Victim)))
        options: Any = {"isolation": "process", "recovery": hf.checkpoint_only(), "restart": "temporary"}
        evil = await system.start(hf.child("evil", hf.start(Evil), **options))
        with system.events() as events:
            evil.tell(Write(frame(f.Record(evil.path, raw(ENDLESS[what](number))))))
            breach = await next_event(events, hf.events.TrustBreached)
        assert breach.address == evil.path
        assert "float" in breach.problem
        assert await other.ask(Add()) == 1


async def test_an_event_with_a_number_that_is_none_is_not_shown(world: World) -> None:
    with world.system.events() as events:
        for number in (float("inf"), float("nan"), 2.5):
            await world.write(note("ReplayPaced", address=EVIL, turns=1, seconds=number, held=1))
        assert await world.evil.ask(Ping(), timeout=60) == 1
        assert [event.seconds for event in events.take() if isinstance(event, hf.events.ReplayPaced)] == [2.5]
