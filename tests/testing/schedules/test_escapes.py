"""What no seed decides is told in the run in which it is used, or found by the run that is made twice."""

from __future__ import annotations

import asyncio
import itertools
import logging
import os
import signal
import threading
import time
import warnings
from collections.abc import Awaitable, Callable
from datetime import UTC, date, datetime, timedelta
from typing import Any

import anyio
import anyio.to_thread
import pytest

import holdfast as hf
from holdfast.testing import GuardedSystem, simulate
from holdfast.testing.schedules.choices import NotRepeatable, Production, Walk
from holdfast.testing.schedules.world import EPOCH, EscapesSimulation
from holdfast.testing.simulation import run_schedule
from tests.testing.schedules import by_name


class Go(hf.Message):
    """A turn that is seen in the trace."""


class Goer(hf.Actor):
    """Takes turns."""

    @hf.on(Go)
    def go(self, message: Go) -> None:
        pass


async def waits_for_a_timer() -> None:
    loop = asyncio.get_running_loop()
    done = loop.create_future()
    threading.Timer(0.001, ring, (loop, done)).start()
    await done


def ring(loop: asyncio.AbstractEventLoop, done: asyncio.Future[None]) -> None:
    loop.call_soon_threadsafe(done.set_result, None)


async def watches_a_pipe(end: int) -> None:
    loop, pipe = asyncio.get_running_loop(), os.pipe()
    os.write(pipe[1], b"x")
    done = loop.create_future()

    def heard() -> None:
        (loop.remove_writer if end else loop.remove_reader)(pipe[end])
        done.set_result(None)

    (loop.add_writer if end else loop.add_reader)(pipe[end], heard)
    await done
    for number in pipe:
        os.close(number)


async def waits_for_a_pipe_by_anyio() -> None:
    pipe = os.pipe()
    os.write(pipe[1], b"x")
    await anyio.wait_readable(pipe[0])
    for number in pipe:
        os.close(number)


async def streams_through_a_pipe() -> None:
    loop, pipe, reader = asyncio.get_running_loop(), os.pipe(), asyncio.StreamReader()
    with os.fdopen(pipe[0], "rb") as file:
        transport, _ = await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), file)
        os.close(pipe[1])
        await reader.read()
        transport.close()
        await asyncio.sleep(0)


def handle_signal() -> None:
    """It never comes."""


async def waits_for_a_signal() -> None:
    loop = asyncio.get_running_loop()
    loop.add_signal_handler(signal.SIGUSR1, handle_signal)
    loop.remove_signal_handler(signal.SIGUSR1)


@pytest.mark.parametrize(
    ("escape", "told"),
    [
        (waits_for_a_timer, r"a threading\.Timer was started \(.*\.ring\): it waits for real time"),
        (lambda: watches_a_pipe(0), r"a pipe is read \(.*watches_a_pipe.<locals>.heard\)"),
        (lambda: watches_a_pipe(1), r"a pipe is written \(.*watches_a_pipe.<locals>.heard\)"),
        (waits_for_a_pipe_by_anyio, r"a pipe is read \(anyio"),
        (streams_through_a_pipe, r"a pipe is read \(asyncio.unix_events._UnixReadPipeTransport"),
        (waits_for_a_signal, r"a signal is waited for \(.*\.handle_signal\)"),
    ],
)
def test_what_comes_from_outside_is_told_by_name(escape: Callable[[], Awaitable[None]], told: str) -> None:
    async def escapes(system: GuardedSystem) -> None:
        await escape()

    with pytest.warns(EscapesSimulation, match=told):
        run_schedule(escapes, Production(0), {"system"}, {})


@pytest.mark.parametrize("seed", range(5))
def test_what_threads_of_anyio_bring_comes_in_the_order_in_which_it_was_asked_for(seed: int) -> None:
    ended: list[int] = []

    async def works(system: GuardedSystem) -> None:
        gates = [threading.Event() for _ in range(4)]
        gates[3].set()

        def work(number: int) -> int:
            gates[number].wait()
            if number:  # The last one ends first.
                gates[number - 1].set()
            return number

        async def one(number: int) -> None:
            ended.append(await anyio.to_thread.run_sync(work, number))

        async with anyio.create_task_group() as group:
            for number in range(4):
                group.start_soon(one, number)

    run_schedule(works, Walk(seed), {"system"}, {})
    first, ended = ended, []
    run_schedule(works, Walk(seed), {"system"}, {})
    assert first == ended
    assert sorted(first) == [0, 1, 2, 3]


class Moment(datetime):
    """A user's own."""


def test_the_date_is_the_runs_also_where_the_class_was_imported_by_name() -> None:
    epoch = datetime.fromtimestamp(EPOCH)
    real: list[datetime] = []

    async def dated(system: GuardedSystem) -> None:
        system.spawn(hf.start(Goer), f"at{datetime.now():%H%M%S%f}").tell(Go())
        await asyncio.sleep(60)
        later = epoch + timedelta(seconds=60)
        assert [datetime.now(), datetime.today(), Moment.now()] == [later] * 3
        assert [type(Moment.now()), type(Moment.now(UTC))] == [Moment] * 2
        assert datetime.now(UTC) == datetime.now(tz=UTC) == later.astimezone(UTC)
        assert datetime.now(UTC) == datetime.fromtimestamp(time.time(), UTC)
        assert date.today() == later.date()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            utcnow: Any = vars(datetime)["utcnow"].__get__(None, datetime)  # deprecated, and still in use
            assert utcnow() == datetime.now(UTC).replace(tzinfo=None)
        with pytest.raises(TypeError):
            datetime.now("noon")  # type: ignore[arg-type]
        await asyncio.to_thread(lambda: real.append(datetime.now()))  # A thread has the real world.

    before = datetime.now()
    now = vars(datetime)["now"]
    simulate(dated, seeds=11)()
    assert before <= datetime.now() < before + timedelta(minutes=10)
    assert all(before <= one < before + timedelta(minutes=10) for one in real)
    assert len(real) == 13  # Two of the eleven runs are made twice.
    assert vars(datetime)["now"] is now


class Plain:
    """Has no order but that of its address."""

    def __init__(self, number: int) -> None:
        self.number = number


@pytest.mark.parametrize("seed", range(5))
def test_the_order_of_a_set_of_objects_is_found_by_the_second_run(seed: int) -> None:
    kept: list[Plain] = []  # farther apart in each run, as the allocator may give the same addresses again
    runs = itertools.count(1)

    async def in_order(system: GuardedSystem) -> None:
        step = next(runs)
        kept.extend(Plain(number // step) for number in range(8 * step))
        for one in set(kept[-8 * step :: step]):
            system.spawn(hf.start(Goer), f"goer{one.number}").tell(Go())
        await asyncio.sleep(1)

    with pytest.raises(NotRepeatable, match="the addresses of objects"):
        simulate(in_order, seed=10 * seed)()


class Read(hf.Message[str]):
    """Answered with what a clock shows, or a generator draws."""

    which: str


READINGS: dict[str, Callable[[], object]] = {
    "time.time": lambda: time.time(),
    "time.monotonic_ns": lambda: time.monotonic_ns(),
    "datetime.now": lambda: datetime.now(UTC),
    "date.today": lambda: date.today(),
    "os.urandom": lambda: os.urandom(4),
}


class Reader(hf.Actor):
    """Asks the world."""

    @hf.on(Read)
    def read(self, message: Read) -> str:
        return str(READINGS[message.which]())


@pytest.mark.parametrize("which", READINGS)
@simulate(seeds=2)
async def test_a_strict_actor_is_refused_a_simulated_clock_as_it_is_a_real_one(
    system: GuardedSystem, which: str
) -> None:
    """A seed decides what it shows, and a replay after a crash shows something else all the same."""
    system.expect_crashes()
    ref = await system.start(hf.child("reader", hf.start(Reader), recovery=hf.hybrid(strict=True)))
    with pytest.raises(hf.RemoteCrash, match="NotDeterministic"):
        await ref.ask(Read(which))
    free = await system.start(hf.child("free", hf.start(Reader), recovery=hf.hybrid()))
    assert await free.ask(Read(which))


def test_what_a_module_has_by_name_is_the_seeds_too() -> None:
    seen: list[list[str]] = []

    async def looks(system: GuardedSystem) -> None:
        seen.append(await system.spawn(hf.start(by_name.Looker)).ask(by_name.Look()))

    real = [by_name.what_time_it_is, by_name.urandom, by_name.OWN.getstate(), by_name.NEW.bit_generator.state]
    for seed in (1, 1, 2):
        run_schedule(looks, Production(seed), {"system"}, {})
        assert [
            by_name.what_time_it_is,
            by_name.urandom,
            by_name.OWN.getstate(),
            by_name.NEW.bit_generator.state,
        ] == real
    assert seen[0] == seen[1]
    assert float(seen[0][0]) == EPOCH
    assert not {*seen[0][4:]} & {*seen[2]}


class Note(hf.Message[str]):
    """A text."""

    text: str


class Describer(hf.Actor):
    """Describes something by the address of an object."""

    def __init__(self) -> None:
        self.plain = Plain(1)

    @hf.on(Note)
    def describe(self, message: Note) -> str:
        match message.text:
            case "reply":
                return f"{self.plain}"
            case "log":
                logging.getLogger("describer").info("%s", self.plain)
                return f"{self.plain}"[:20]
            case _:
                return "nothing"


async def sends_a_default_text(system: GuardedSystem) -> None:
    plain = Plain(2)
    system.spawn(hf.start(Describer), "describer").tell(Note(f"with {plain} in it"))
    await asyncio.sleep(1)


async def is_replied_a_default_text(system: GuardedSystem) -> None:
    await system.spawn(hf.start(Describer), "describer").ask(Note("reply"))


@pytest.mark.parametrize(
    ("shows", "told"),
    [
        (sends_a_default_text, r"Note to /app/describer shows the address of an object \(Plain\)"),
        (is_replied_a_default_text, r"the reply of /app/describer to Note shows the address of an object \(Plain\)"),
    ],
)
def test_a_default_text_that_is_sent_is_told_in_the_run_in_which_it_is(shows: Any, told: str) -> None:
    with pytest.warns(EscapesSimulation, match=told):
        run_schedule(shows, Production(0), {"system"}, {})


@pytest.mark.parametrize(
    "text",
    ["<Plain object at 0x10>", "we meet at 0x", f"at {0x7F3A_0000_0010:#x} nobody is", "log"],
)
def test_texts_that_show_no_living_object_and_what_is_only_logged_are_not_told(text: str) -> None:
    async def tells(system: GuardedSystem) -> None:
        await system.spawn(hf.start(Describer), "describer").ask(Note(text))

    simulate(tells, seeds=11)()


def test_a_number_from_id_in_a_message_is_found_by_the_second_run() -> None:
    kept: list[Plain] = []

    async def escapes(system: GuardedSystem) -> None:
        kept.append(Plain(1))
        await system.spawn(hf.start(Describer), "describer").ask(Note(str(id(kept[-1]))))

    with pytest.raises(NotRepeatable, match=r"in turn \d+ \w+ of /app/describer Note was '\d+'"):
        simulate(escapes, seeds=11)()


def test_what_is_never_sent_is_not_found() -> None:
    """The limits, as docs/simulation.md has them."""
    kept: list[Plain] = []
    seen: list[str] = []

    async def escapes(system: GuardedSystem) -> None:
        kept.extend(Plain(number) for number in range(8))
        seen.append("".join(str(one.number) for one in set(kept[-8:])))
        await system.spawn(hf.start(Describer), "describer").ask(Note("nothing"))

    simulate(escapes, seeds=11)()
    assert len(seen) == 13
