"""The watch over a keeper: its program ends in time even if the keeper is stopped by a signal, or hangs."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import os
import subprocess
from collections.abc import Callable
from typing import Final

from ...streams import check_can_watch
from ..fork.child_processes import parent_of, signal_by
from ..fork.forked_process import has_ended
from ..owed_answer import LOOK_SECONDS, OwedAnswer

START_SECONDS: Final = 10.0
"""Seconds within which a keeper has to start its program."""
END_SECONDS: Final = 2.0
"""Seconds within which a keeper has to end all that is left of its program, and itself."""


class KeeperWatch:
    """Has a keeper do its work in time, and does it instead when the time is over.

    Args:
        keeper: a child of this process that nobody reaps before `close`.
        stuck: told how it was found, and what was done.
        denied: told why something of the program cannot be killed.

    Attributes:
        status: the wait status of the program, if it was found here and not told by the keeper.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        keeper: subprocess.Popen[bytes],
        stuck: Callable[[str], None],
        denied: Callable[[str], None],
    ) -> None:
        self._loop, self._keeper, self._stuck, self._denied = loop, keeper, stuck, denied
        self.status: int | None = None
        self._program, self._pidfd = -1, -1
        self._is_ending = False
        self._timer: asyncio.TimerHandle | None = None
        self._owed = self._owes(START_SECONDS)

    def _owes(self, seconds: float) -> OwedAnswer:
        late = functools.partial(self._give_up, seconds)
        return OwedAnswer(self._loop, self._keeper.pid, self._was_stopped, within=seconds, late=late)

    def _was_stopped(self) -> None:
        self._stuck("it was stopped by a signal, and was told to go on")

    def started(self, pid: int) -> None:
        """The keeper has started its program.

        Raises:
            OSError: the program cannot be watched.
        """
        if not self._is_ending:
            self._owed.close()
        self._program = pid
        try:
            self._pidfd = os.pidfd_open(pid)
            check_can_watch(self._pidfd)
        except ProcessLookupError:
            self.owes_end()
            return
        self._loop.add_reader(self._pidfd, self._program_ended)
        if parent_of(pid) != self._keeper.pid:  # It has ended, and its number may mean somebody else by now.
            self._program_ended()

    def _program_ended(self) -> None:
        self._close_program()
        self.owes_end()

    def signal(self, number: int, *, group: bool) -> None:
        """Send a signal to the program, or to its process group, unless it has ended."""
        if self._pidfd < 0 or has_ended(self._pidfd):
            return
        if group:
            with contextlib.suppress(OSError):  # It is another user's: what follows in the end is SIGKILL.
                os.killpg(self._program, number)
        else:
            signal_by(self._pidfd, number)

    def owes_end(self) -> None:
        """All that is left of the program is to be ended now, by the keeper if it does so in time."""
        if not self._is_ending:
            self._is_ending = True
            self._owed.close()
            self._owed = self._owes(END_SECONDS)

    def excuse(self) -> None:
        """The keeper has said why it cannot end the program: it is waited for."""
        self._owed.close()
        self._cancel()

    def _give_up(self, seconds: float) -> None:
        self._is_ending = True
        self._end_program(seconds, seen_empty=False)

    def _end_program(self, seconds: float, seen_empty: bool) -> None:
        """Kill all that descends from the keeper, and when nothing of that lives any more the keeper itself.

        It is not killed before: what loses its parent comes to it, and so is found. It may have come to work meanwhile.
        """
        if self.status is None:
            self.status = exit_status(self._program, self._keeper.pid)
        left, why = kill_below(self._keeper.pid)
        if why:
            self._denied(why)
        elif not left and seen_empty:
            self._stuck(f"it has done nothing for {seconds:g} s, and was killed")
            self._keeper.kill()
        else:
            self._timer = self._loop.call_later(LOOK_SECONDS, self._end_program, seconds, not left)

    def _close_program(self) -> None:
        if self._pidfd >= 0:
            self._loop.remove_reader(self._pidfd)
            os.close(self._pidfd)
            self._pidfd = -1

    def _cancel(self) -> None:
        if self._timer is not None:
            self._timer.cancel()

    def close(self) -> None:
        """Let go of the program, for its keeper has ended."""
        self._owed.close()
        self._cancel()
        self._close_program()


def exit_status(pid: int, parent: int) -> int | None:
    """The wait status of a child of `parent` that has ended and is not reaped yet; else None."""
    try:
        with open(f"/proc/{pid}/stat", "rb", buffering=0) as file:
            fields = file.read(4096).rpartition(b")")[2].split()
    except OSError:
        return None
    is_dead_child = len(fields) > 49 and fields[0] == b"Z" and int(fields[1]) == parent
    return int(fields[49]) if is_dead_child else None


def kill_below(pid: int) -> tuple[list[int], str]:
    """SIGKILL for all that descends from a process. Returns who of them was alive, and why one cannot be killed."""
    import psutil

    left, why = list[int](), ""
    try:
        found = psutil.Process(pid).children(recursive=True)
    except psutil.NoSuchProcess:
        return left, why
    for one in found:
        with contextlib.suppress(psutil.NoSuchProcess):
            try:
                if one.status() != psutil.STATUS_ZOMBIE:
                    left.append(one.pid)
                    one.kill()
            except psutil.AccessDenied:
                why = f"process {one.pid}: {os.strerror(1)}"
    return left, why
