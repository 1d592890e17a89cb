"""What the six robot programs share: what a program is, the data it reads, and a runner that kills it on the way.

Each program is one stateful actor, the messages of a real recording (or of a simulated robot on a real map), and a
judgement of what the actor holds at the end. They stand for the programs of the paper's evaluation:

    mapping            hector_mapping   a map by matching laser scans
    visual_map         RTAB-Map         a map from photos that closes loops
    visual_odometry    ORB_SLAM2        a 3D model from a stereo camera
    planning           move_base        ways to goals
    particle_filter    AMCL             where is the robot? by a cloud of guesses
    scan_localisation  LaMa_local       where is the robot? by matching scans with a map

Each runs alone:

    python examples/programs/mapping.py --method fresh --kill-at 9s --kill-at 300

Data: the folder `HOLDFAST_DATA`, else `../shared/data` beside the checkout; the Killian Court log is in `rtb-data`.

Source: Zou and Bai, *Effective Crash Recovery of Robot Software Programs in ROS*, section IV.
"""

from __future__ import annotations

import argparse
import asyncio
import gzip
import os
import signal
import sys
import time
import zipfile
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Generator, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import psutil

import holdfast as hf
from holdfast.actors.values import encode_value, state_digest
from holdfast.checkpoint.method import Method

DATA = Path(os.environ.get("HOLDFAST_DATA", Path(__file__).resolve().parents[3] / "shared/data"))
PATIENCE = 60.0  # seconds for one answer, a recovery included

Isolation = Literal["task", "process"]


class Timed(NamedTuple):
    """A message, and when it was recorded: seconds since the first one of the run."""

    time: float
    message: hf.Message[Any]


Feed = Generator[Timed, Any, None]
"""Messages in order. It is sent each reply, None if the message was lost: a simulated robot obeys its program."""


class Verdict(NamedTuple):
    """Whether the program did its task, and the figures that say so."""

    correct: bool
    figures: str


class MissingData(Exception):
    """A file that a program reads is not there."""


class DamagedData(Exception):
    """A file that a program reads is not what it should be; says where."""


class Program(ABC):
    """One run's worth of a program; make a new one for each run."""

    name: ClassVar[str]

    @abstractmethod
    def __init__(self, data: Path = DATA, limit: int | None = None) -> None:
        """Read the data.

        Args:
            data: the folder with the files.
            limit: the most messages that the feed gives, at least 2; None for all.

        Raises:
            MissingData, DamagedData: naming the file.
        """

    @abstractmethod
    def start(self) -> hf.Start[Any]:
        """The actor."""

    @abstractmethod
    def feed(self) -> Feed:
        """What it is told, from the first message on."""

    @abstractmethod
    def judge(self, state: dict[str, Any]) -> Verdict:
        """Did it do its task? `state` are its key variables after the last message of the feed."""


@dataclass(frozen=True)
class Result:
    """How a run went.

    Attributes:
        digest: of the actor's key variables at the end; equal only if every bit is.
        messages: given by the feed, of which `lost` were not answered.
        start_seconds: until the actor was up for the first time.
        waits: seconds from asking to answer, of each message.
        state_bytes: size of the key variables in a snapshot.
        memory: bytes of all processes at the end, what they share counted once (PSS).
        recoveries: reports of the recoveries, one per kill (none with `fresh`).
    """

    digest: str
    verdict: Verdict
    messages: int
    lost: int
    start_seconds: float
    waits: tuple[float, ...]
    state_bytes: int
    memory: int
    recoveries: tuple[hf.events.Recovered, ...]

    @property
    def seconds(self) -> float:
        """From asking to answer, summed over all messages."""
        return sum(self.waits)


async def run(
    program: Program,
    method: Method | None = None,
    *,
    kill_at: Collection[int | float] = (),
    isolation: Isolation = "process",
    speed: float = 0.0,
    store: str | None = None,
) -> Result:
    """Run a program to the end of its feed.

    Args:
        program: a new one.
        method: how it is recovered; None: `hybrid` with a snapshot every 2 s, as in the paper.
        kill_at: when the actor's process gets SIGKILL, each time with a message on its way: the number of that message,
            from 1, as an int, or seconds of the recording as a float.
        isolation: "task" runs the actor in this process, where it cannot be killed. Set OMP_NUM_THREADS=1 before it
            starts, as processes of actors have it: with more threads sums may be rounded otherwise.
        speed: a multiple of the pace of the recording; 0: each message as soon as the one before is answered.
        store: where journal and snapshots go; None: memory.

    Raises:
        ValueError: an actor without a process was to be killed.
    """
    if kill_at and isolation == "task":
        raise ValueError("only an actor in a process can be killed")
    async with hf.ActorSystem("robot", store=store, log=False, intensity=len(kill_at) + 1) as system:
        recovery = hf.hybrid(interval=2.0) if method is None else method
        began = time.perf_counter()
        ref = await system.start(hf.child("program", program.start(), isolation=isolation, recovery=recovery))
        start_seconds = time.perf_counter() - began
        with system.events() as events:
            drive = _Drive(system, ref, kill_at, speed)
            await drive.through(program.feed())
            state = await system.get_state(ref, timeout=PATIENCE)
            memory = resident_bytes()
            await system._node.settled()  # The last report of a recovery comes a little after it.
            recoveries = tuple(event for event in events.take() if isinstance(event, hf.events.Recovered))
    return Result(
        digest=state_digest(state).hex(),
        verdict=program.judge(state),
        messages=drive.messages,
        lost=drive.lost,
        start_seconds=start_seconds,
        waits=tuple(drive.waits),
        state_bytes=len(encode_value(state)),
        memory=memory,
        recoveries=recoveries,
    )


class _Drive:
    """Asks the actor one message of the feed after the other, and kills it where it is to be killed."""

    def __init__(
        self, system: hf.ActorSystem, ref: hf.ActorRef[Any], kill_at: Collection[int | float], speed: float
    ) -> None:
        self._system, self._ref, self._speed = system, ref, speed
        self._kill_numbers = {moment for moment in kill_at if isinstance(moment, int)}
        self._kill_times = sorted(moment for moment in kill_at if isinstance(moment, float))
        self.messages, self.lost = 0, 0
        self.waits: list[float] = []

    async def through(self, feed: Feed) -> None:
        began = time.perf_counter()
        reply = None
        while True:
            try:
                timed = feed.send(reply)
            except StopIteration:
                return
            if self._speed:
                await asyncio.sleep(began + timed.time / self._speed - time.perf_counter())
            self.messages += 1
            reply = await self._ask(timed.message, kill=self._is_to_be_killed(timed.time))

    def _is_to_be_killed(self, now: float) -> bool:
        due = bool(self._kill_times) and now >= self._kill_times[0]
        if due:
            self._kill_times.pop(0)
        return due or self.messages in self._kill_numbers

    async def _ask(self, message: hf.Message[Any], *, kill: bool) -> Any:
        asked = time.perf_counter()
        answer = self._ref.ask(message, timeout=PATIENCE)
        if kill:
            await asyncio.sleep(0)  # The message leaves for the process.
            with suppress(hf.errors.NoSuchActor, ProcessLookupError):  # It is still dead from the time before.
                os.kill(self._system.pid_of(self._ref), signal.SIGKILL)
        try:
            return await answer
        except hf.AskFailed:  # Without recovery the message in its turn is gone.
            self.lost += 1
            return None
        finally:
            self.waits.append(time.perf_counter() - asked)


def resident_bytes() -> int:
    """Memory of this process and all below it; what several share is counted once."""
    own = psutil.Process()
    return sum(one.memory_full_info().pss for one in (own, *own.children(recursive=True)))


def find_file(data: Path, name: str) -> Path:
    """A file of the data folder.

    Raises:
        MissingData: it is not there.
    """
    path = data / name
    if not path.is_file():
        raise MissingData(f"there is no file {name} in {data} (set HOLDFAST_DATA)")
    return path


@contextmanager
def reading(path: Path) -> Generator[None]:
    """Report whatever goes wrong while a file is read as damage of that file.

    Raises:
        DamagedData: naming the file and the reason.
    """
    try:
        yield
    except (OSError, EOFError, ValueError, zlib.error, zipfile.BadZipFile) as error:
        raise DamagedData(f"{path}: {error}") from error


def read_numbers(path: Path, *, columns: int) -> Iterator[list[float]]:
    """The lines of a table of numbers in text, or .gz of it; blank lines are left out.

    Raises:
        DamagedData: naming file and line, if a line has not so many columns or one is no number.
    """
    number = 0
    with reading(path), gzip.open(path, "rt") if path.suffix == ".gz" else path.open() as lines:
        for number, line in enumerate(lines, start=1):
            fields = line.split()
            if fields and len(fields) != columns:
                raise ValueError(f"line {number} has {len(fields)} fields, expected {columns}")
            if fields:
                yield _floats(fields, number)


def _floats(fields: list[str], line: int) -> list[float]:
    try:
        return [float(field) for field in fields]
    except ValueError as error:
        raise ValueError(f"line {line}: {error}") from None


def main(kind: Callable[[Path, int | None], Program]) -> None:
    """The command line of a program."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--limit", type=int, metavar="N", help="only the first N messages")
    parser.add_argument("--method", choices=("hybrid", "fresh"), default="hybrid")
    parser.add_argument(
        "--kill-at", action="append", type=_moment, default=[], metavar="N|SECONDS", help="as 300, or as 9s"
    )
    parser.add_argument(
        "--speed", type=float, default=0.0, metavar="X", help="times the recording's pace; 0: full speed"
    )
    options = parser.parse_args()
    if options.limit is not None and options.limit < 2:
        parser.error("--limit: two messages at least")
    try:
        program = kind(DATA, options.limit)
    except MissingData as error:
        print(f"skipped: {error}")
        return
    except DamagedData as error:
        sys.exit(str(error))
    method = hf.hybrid(interval=2.0) if options.method == "hybrid" else hf.fresh()
    result = hf.run(run(program, method, kill_at=options.kill_at, speed=options.speed))
    print(f"{program.name}: {'correct' if result.verdict.correct else 'NOT correct'}: {result.verdict.figures}")
    print(
        f"{result.messages} messages, {result.lost} lost, {1000 * result.seconds / result.messages:.1f} ms each, "
        f"state {result.state_bytes:,} bytes, digest {result.digest}"
    )
    for recovered in result.recoveries:
        print(f"recovered in {1000 * sum(recovered.phases.values()):.0f} ms, {recovered.replayed} messages replayed")


def _moment(text: str) -> int | float:
    return float(text[:-1]) if text.endswith("s") else int(text)
