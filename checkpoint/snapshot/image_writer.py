"""Images of a large state, taken by its life between two turns: what has changed is written into shared memory.

Two ways, chosen by size and by where the actor lives. *Copy*: the state is compared with the last image and what
differs is written, while the actor stands still. *Fork*: a copy of the process does that, while the actor goes on; the
price is a page fault for each page it changes meanwhile. A process is forked only while no other thread runs in it.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import signal
import threading
import time
from collections import Counter
from typing import TYPE_CHECKING, Any, Final

import msgspec

from ...actors.process.fork.boot import PR_SET_PDEATHSIG, bind_prctl
from ...actors.process.owed_answer import OwedAnswer
from ...actors.streams import check_can_watch
from ...actors.values import ByteParts
from ..protocol import Kept, Lent, Marked, Shared, Snapshot, Unsaved
from .key_variables import state_of, variables
from .mapped_image import map_image
from .shared_blocks import (
    NOWHERE,
    Digests,
    Layout,
    Place,
    Segment,
    by_segment,
    can_share,
    known_places,
    layout_of,
    memory_file,
    new_number,
    places_of,
    write_changed,
)
from .state_image import IMAGE_BYTES, Imager, Key, estimate, is_image

if TYPE_CHECKING:
    from ..life.recorded_life import Life

FORK_BYTES: Final = 16 * 1024 * 1024
"""States from this size on are written by a forked process, where that is possible: below, a copy is quicker."""
MOST_COPIED: Final = 200 * 1024 * 1024
"""Arrays up to this size that are rewritten between two snapshots are copied: a fault for each page takes longer."""
MOST_SEGMENTS: Final = 32
"""Segments that one image may be spread over before what the smallest have is written anew."""
_prctl = bind_prctl()


class Written(msgspec.Struct, array_like=True):
    """What a forked writer reports."""

    layout: list[tuple[Key, list[Place]]] = []
    problem: str = ""


class Imaging:
    """The images of one life."""

    def __init__(self, life: Life, *, may_fork: bool) -> None:
        self._life, self._may_fork = life, may_fork
        self._imager = Imager()
        self._layout: Layout = {}
        self._begun_with: Layout = {}  # of the state that the life has begun with, as far as it is known
        self._segments: dict[int, Segment] = {}
        self._digests: Digests = {}  # of chunks, and of the blocks that are in none of these
        self._written: tuple[Segment, Layout] | None = None  # what the home has not acknowledged yet
        self._writer: Writer | None = None
        self._is_again = False
        self._last_share = 1.0  # of the last image was new
        self.last_bytes = 0

    @property
    def files(self) -> list[int]:
        """The descriptors of the segments that the next image is compared with."""
        return [segment.file for segment in self._segments.values()]

    @property
    def is_busy(self) -> bool:
        """Whether an image is being written or kept."""
        return self._writer is not None or self._written is not None

    def mapped(self, lent: Lent) -> ByteParts:
        """The state that a home lends; what does not change of it is not written again.

        Raises:
            HoldfastError: it is not there any more. OSError: there is no room for it.
        """
        data, places, self._segments = map_image(lent)
        if is_image(data):
            self._begun_with = known_places(data, places)
        else:  # The home has no such blocks.
            self.restart()
        return data

    def suits(self) -> bool:
        """Whether the state is large enough."""
        actor = self._life.cell.actor
        assert actor is not None
        if not can_share():
            return False
        return max(self.last_bytes, estimate(actor, variables(actor), below=True)) >= IMAGE_BYTES

    def take(self) -> None:
        """Write an image of the state after the last turn; one that is under way is waited for, then one more follows.

        Raises:
            UnsavableValue, StateMismatch, what `get_state` raises: it cannot be saved.
        """
        if self.is_busy:
            self._is_again = True
            return
        life, actor = self._life, self._life.cell.actor
        assert actor is not None
        begin = time.perf_counter()
        state = state_of(actor)
        number = new_number()
        file = memory_file(number)
        job = _Job(life.turn, [fed.feed.id for fed in life.stash], number, file, life.traps)
        writer: Writer | None = None
        try:
            if self._will_fork():
                writer = Writer(self, job, state)
                life.port.to_home(Marked(life.turn))
                self._writer = writer
                job.pause = time.perf_counter() - begin
                return
            layout = self.write(job, state)
            self._imager.remember()
        except BaseException:
            if writer is not None:
                writer.kill()
            else:
                os.close(file)
            raise
        job.pause = time.perf_counter() - begin
        self._hand_over(job, layout)

    def _will_fork(self) -> bool:
        """Whether a copy of the process is to write the next image of the state."""
        actor = self._life.cell.actor
        assert actor is not None
        names = variables(actor)
        arrays, size = estimate(actor, names), max(self.last_bytes, estimate(actor, names, below=True))
        is_rewritten = self._last_share > 0.5 and arrays > 0.9 * size
        should = size >= FORK_BYTES and not (is_rewritten and size <= MOST_COPIED)
        return self._may_fork and should and is_alone()

    def write(self, job: _Job, state: Any) -> Layout:
        """Write what differs from the last image that is kept."""
        pieces = self._imager.image(state.version, state.form, state.value, self._life.cell.path)
        known = self._layout or layout_of(pieces, self._begun_with)
        return write_changed(job.file, job.number, pieces, known, self._segments, self._digests)

    def written(self, job: _Job, layout: Layout) -> None:
        """A forked writer is ready."""
        self._writer = None
        try:
            self._hand_over(job, layout)
        except Exception as error:  # Nobody else would hear of it.
            self._unsaved(str(error))

    def failed(self, job: _Job, problem: str) -> None:
        """A forked writer is not."""
        self._writer = None
        os.close(job.file)
        self._unsaved(problem)

    def _unsaved(self, problem: str) -> None:
        self._life.port.to_home(Unsaved(problem))
        self._once_more()

    def _hand_over(self, job: _Job, layout: Layout) -> None:
        """Tell the home of an image; if that raises, nothing of it stays."""
        try:
            segment = Segment(job.number, job.file)
        except BaseException:
            os.close(job.file)
            raise
        self._written = segment, layout
        try:
            self._tell_home(job, segment, layout)
        except BaseException:
            if self._written is not None:  # Else the home has it already.
                self._written = None
                segment.close()
                self._life.image_lost()
            raise

    def _tell_home(self, job: _Job, segment: Segment, layout: Layout) -> None:
        life, places = self._life, places_of(layout)
        self.last_bytes = sum(length for _, _, length in places)
        new = sum(length for number, _, length in places if number == job.number)
        self._last_share = new / max(1, self.last_bytes)
        is_idle = self._will_fork()
        shared = Shared(job.number, os.getpid(), job.file, segment.inode, segment.size, places, is_idle)
        life.image_taken(job.turn)
        said = life.made_by()
        life.port.to_home(Snapshot(job.turn, b"", True, job.stash, job.pause, False, shared, job.traps, *said))

    def kept(self, record: Kept) -> None:
        """The home has it, or has not."""
        if self._written is None or self._written[0].number != record.segment:
            return
        (segment, layout), self._written = self._written, None
        if not record.is_safe:
            segment.close()
            self._life.image_lost()
        else:
            self._segments[segment.number] = segment
            places = places_of(layout)
            for index, digest in record.digests.items():
                self._digests[places[index]] = digest
            for number in {places[index][0] for index in record.digests} & self._segments.keys():
                self._segments.pop(number).close()
            self._layout, self._begun_with = layout, {}
            if record.is_full:
                self.restart()
            elif self._forget() > MOST_SEGMENTS:
                self._gather()
        self._once_more()

    def _forget(self) -> int:
        """Let go of what the last image does not need; returns over how many segments it is spread."""
        wanted = by_segment(places_of(self._layout))
        for number in list(self._segments):
            if number not in wanted:
                self._segments.pop(number).close()
        for place in [place for place in self._digests if place[1:] not in wanted.get(place[0], ())]:
            del self._digests[place]
        return len(wanted)

    def _gather(self) -> None:
        """Have the next image write what is scattered over the smallest segments anew, in one."""
        sizes = Counter[int]()
        for number, _, length in places_of(self._layout):
            sizes[number] += length
        kept = {number for number, _ in sizes.most_common(MOST_SEGMENTS // 2)}
        self._layout = {
            key: [place if place[0] in kept else NOWHERE for place in places] for key, places in self._layout.items()
        }
        self._forget()

    def restart(self) -> None:
        """Write the next image in full."""
        self._layout, self._begun_with = {}, {}
        for segment in self._segments.values():
            segment.close()
        self._segments.clear()
        self._digests.clear()

    def _once_more(self) -> None:
        again, self._is_again = self._is_again, False
        if again:
            self._life.want_snapshot()

    def stop(self) -> None:
        """What is under way does not count: a newer state is saved in another way, or the life is over."""
        if self._writer is not None:
            self._writer.kill()
            self._writer = None
        if self._written is not None:
            self._written[0].close()
            self._written = None
        self._is_again = False

    def close(self) -> None:
        """Write no more images: the life is over."""
        self.stop()
        self.restart()


class _Job:
    """One image to be written: after which turn, into which file."""

    def __init__(self, turn: int, stash: list[int], number: int, file: int, traps: bool) -> None:
        self.turn, self.stash, self.number, self.file, self.traps = turn, stash, number, file, traps
        self.pause = 0.0


class Writer:
    """A forked process that writes an image, and how its report is heard."""

    def __init__(self, imaging: Imaging, job: _Job, state: Any) -> None:
        self._imaging, self._job = imaging, job
        self._loop = asyncio.get_running_loop()
        self._data = bytearray()
        self._report, out = os.pipe()
        os.set_blocking(self._report, False)
        parent = os.getpid()
        try:
            self.pid = os.fork()
        except OSError:
            os.close(self._report)
            os.close(out)
            raise
        if self.pid == 0:
            _write_and_exit(imaging, job, state, out, parent)
        os.close(out)
        try:
            self._life = os.pidfd_open(self.pid)
            try:
                check_can_watch(self._report, self._life)
            except OSError:
                os.close(self._life)
                raise
        except OSError:
            os.kill(self.pid, signal.SIGKILL)
            os.waitpid(self.pid, 0)
            os.close(self._report)
            raise
        self._loop.add_reader(self._report, self._read)
        self._loop.add_reader(self._life, self._reap)
        self._owed = OwedAnswer(self._loop, self.pid)

    def _read(self) -> None:
        try:
            data = os.read(self._report, 1 << 20)
        except BlockingIOError:
            return
        if data:
            self._data += data
            return
        self._stop_reading()
        imaging, job = self._imaging, self._job
        try:
            report = msgspec.msgpack.decode(self._data, type=Written)
        except msgspec.DecodeError:
            report = Written(problem="the process that wrote it has died")
        if report.problem:
            imaging.failed(job, report.problem)
        else:
            imaging.written(job, dict(report.layout))

    def _stop_reading(self) -> None:
        if self._report >= 0:
            self._owed.close()
            self._loop.remove_reader(self._report)
            os.close(self._report)
            self._report = -1

    def _reap(self) -> None:
        self._loop.remove_reader(self._life)
        os.close(self._life)
        with contextlib.suppress(ChildProcessError):
            os.waitpid(self.pid, 0)

    def kill(self) -> None:
        """It is not needed any more."""
        if self._report < 0:
            return
        self._stop_reading()
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._life, signal.SIGKILL)
        os.close(self._job.file)


def is_alone() -> bool:
    """Whether this process has no thread but this one: only then may it be forked."""
    return threading.active_count() == 1 and len(os.listdir("/proc/self/task")) == 1


def _write_and_exit(imaging: Imaging, job: _Job, state: Any, out: int, parent: int) -> None:
    """In the forked process: nothing of the program may go on here, and nothing that it holds open stay open."""
    try:
        gc.disable()
        _prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)
        _close_all_but({out, job.file, *imaging.files})
        try:
            layout = imaging.write(job, state)
            report = Written(list(layout.items()))
        except BaseException as error:
            report = Written(problem=str(error) or type(error).__name__)
        data = memoryview(msgspec.msgpack.encode(report))
        while data:
            data = data[os.write(out, data) :]
    finally:
        os._exit(0)


def _close_all_but(files: set[int]) -> None:
    for name in os.listdir("/proc/self/fd"):
        if int(name) not in files:
            with contextlib.suppress(OSError):
                os.close(int(name))
