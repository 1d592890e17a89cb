"""An external program under its keeper, as the process that owns it sees it."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import marshal
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from ...errors import ActorStopped, HoldfastError, ProcessUnavailable
from ...events import HelperStuck
from ...exit_reasons import NORMAL, Exited, ExitReason, Hung, OutOfMemory, Signal
from ...streams import check_can_watch
from ..process_watchdog import ProcessWatch, oom_kills
from ..resource_limits import Limits
from . import reaper
from .keeper_watch import KeeperWatch
from .stdin import InputWriter
from .stdout import OutputReader

if TYPE_CHECKING:
    from ...kernel.node import Node


class ProgramFailed(HoldfastError, text="{program}: {reason}"):
    """An external program could not be started, or was not ready in time; `reason` holds its last lines too."""

    program: str
    reason: str


class KeptProgram:
    """One program: its start, its output, its end.

    Attributes:
        started: the program's pid; fails with ProgramFailed.
        ended: why it ended; set when nothing of it is left, neither processes nor descriptors.
        denied: why it cannot be ended, once that was tried in vain: it runs as another user. It is still watched.
    """

    def __init__(
        self,
        node: Node,
        address: str,
        command: Sequence[str],
        *,
        env: Mapping[str, str],
        cwd: str | None,
        limits: Limits | None,
        on_line: Callable[[str, str], None],
        on_part: Callable[[str, str, str], None] | None = None,
        stdin: bool = False,
    ) -> None:
        """Begin the start.

        Args:
            address: whose program it is.
            env: the whole environment.
            on_line: called with "stdout" or "stderr" and each line.
            on_part: called with that, what has come of a line that has no end yet, and that with the piece before it.
            stdin: whether it gets something to read (`input`); else its standard input is at its end.

        Raises:
            ProcessUnavailable: there is no keeper to be had.
        """
        if not sys.platform.startswith("linux"):
            raise ProcessUnavailable(f"programs as children need Linux (pidfd, prctl); this is {sys.platform}")
        loop = self._loop = node.loop
        self.node, self.pid, self._address, self._name = node, -1, address, command[0]
        self.started: asyncio.Future[int] = loop.create_future()
        self.ended: asyncio.Future[ExitReason] = loop.create_future()
        self.denied: asyncio.Future[str] = loop.create_future()
        self._limits = limits
        self._killed_for: ExitReason | None = None
        self._status: int | None = None
        self._open = 0  # outputs that have not been handed on to their ends
        self._oom_before = oom_kills()
        self._watch: ProcessWatch | None = None
        self.input: InputWriter | None = None
        order = {"command": list(command), "env": dict(env), "cwd": cwd, "limits": _own_limits(limits)}
        try:
            self._exec(marshal.dumps(order), on_line, on_part, stdin)
        except OSError as error:
            raise ProcessUnavailable(f"the keeper of {self._name} cannot be started: {error}") from error

    def _exec(
        self,
        order: bytes,
        on_line: Callable[[str, str], None],
        on_part: Callable[[str, str, str], None] | None,
        stdin: bool,
    ) -> None:
        with contextlib.ExitStack() as theirs, contextlib.ExitStack() as undo:
            self._control, control = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            undo.callback(self._control.close)
            theirs.callback(control.close)
            self._control.setblocking(False)
            order_fd = os.memfd_create("holdfast-order", os.MFD_CLOEXEC)  # Any size, and nobody waits for a reader.
            theirs.callback(os.close, order_fd)
            with open(order_fd, "wb", closefd=False) as file:
                file.write(order)
            os.lseek(order_fd, 0, os.SEEK_SET)
            (out, out_in), (err, err_in) = _pipe(undo, theirs), _pipe(undo, theirs)
            in_out, into = _input_pipe(undo, theirs) if stdin else (subprocess.DEVNULL, -1)
            self._keeper = subprocess.Popen(
                keeper_command(control.fileno(), order_fd),
                stdin=in_out,
                stdout=out_in,
                stderr=err_in,
                pass_fds=(control.fileno(), order_fd),
                start_new_session=True,  # a Ctrl-C in the terminal is not for it
            )
            undo.callback(self._keeper.wait)
            undo.callback(self._keeper.kill)
            self._pidfd = os.pidfd_open(self._keeper.pid)
            undo.callback(os.close, self._pidfd)
            check_can_watch(self._pidfd, self._control.fileno(), out, err)
            loop = self._loop
            for fd, heard in ((self._pidfd, self._bury), (self._control.fileno(), self._read)):
                loop.add_reader(fd, heard)  # A virtual clock refuses.
                undo.callback(loop.remove_reader, fd)
            self._outputs: list[OutputReader] = []
            for name, fd in (("stdout", out), ("stderr", err)):
                part = None if on_part is None else functools.partial(on_part, name)
                self._outputs.append(OutputReader(loop, fd, functools.partial(on_line, name), part))
                undo.callback(loop.remove_reader, fd)
            undo.pop_all()
        self._duty = KeeperWatch(loop, self._keeper, self._stuck, self._deny)
        if into >= 0:
            self.input = InputWriter(loop, into)

    # -- what is asked of it ----------------------------------------------------------------------------------------

    def signal(self, number: int, *, group: bool = False) -> None:
        """Send a signal to the program, or to its whole process group; nothing happens if it has ended."""
        self._duty.signal(number, group=group)

    def given_up(self, error: ActorStopped) -> None:
        """The address is gone for good: nobody waits for a program by its address."""

    def kill(self, reason: ExitReason | None = None) -> None:
        """SIGKILL for the program and all that descends from it; `reason` is then why it ended."""
        if self._killed_for is None:
            self._killed_for = reason or Signal(signal.SIGKILL)
        if not self.ended.done():
            with contextlib.suppress(OSError):
                self._control.shutdown(socket.SHUT_WR)
            self._duty.owes_end()

    @property
    def was_killed(self) -> bool:
        """Whether it was ended from here by SIGKILL."""
        return self._killed_for is not None

    def hold_output(self) -> None:
        """Hand on nothing of what it prints, so that it waits, until `let_output_go_on`, or until it has ended."""
        for output in self._outputs:
            output.hold()

    def let_output_go_on(self) -> None:
        """Hand on what it prints again."""
        for output in self._outputs:
            output.go_on()

    async def wait(self) -> ExitReason:
        """Wait until nothing of it is left."""
        return await asyncio.shield(self.ended)

    async def wait_killed(self) -> None:
        """Wait until nothing of it is left, or it is known that it cannot be ended."""
        await asyncio.wait((self.ended, self.denied), return_when=asyncio.FIRST_COMPLETED)

    # -- what it tells ----------------------------------------------------------------------------------------------

    def _read(self) -> bool:
        """Take one packet; False if there is none."""
        try:
            packet = self._control.recv(8192)
        except BlockingIOError:
            return False
        except OSError:
            packet = b""
        text = packet[1:]
        match packet[:1]:
            case reaper.STARTED:
                self._up(int(text))
            case reaper.FAILED:
                self._duty.owes_end()
                self._fail(text.decode("utf-8", "replace"))
            case reaper.ENDED:
                self._status = int(text)
            case reaper.DENIED:
                self._duty.excuse()
                self._deny(text.decode("utf-8", "replace"))
            case _:
                self._loop.remove_reader(self._control)
                return False
        return True

    def _deny(self, why: str) -> None:
        if not self.denied.done():
            self.denied.set_result(why)

    def _stuck(self, what: str) -> None:
        self.node.emit(HelperStuck(self._address, "keeper", self._keeper.pid, what))

    def _up(self, pid: int) -> None:
        self.pid = pid
        try:
            self._duty.started(pid)
        except OSError as error:
            self._fail(f"it cannot be watched: {error}")
            self.kill()
            return
        limits = self._limits
        if limits is not None:
            import psutil

            with contextlib.suppress(psutil.Error):  # It may have ended already.
                self._watch = ProcessWatch(self, limits)
        if not self.started.done():
            self.started.set_result(pid)

    def _fail(self, why: str) -> None:
        if not self.started.done():
            self.started.set_exception(ProgramFailed(self._name, why))
            self.started.exception()  # Seen: its owner may have ended meanwhile.

    def _bury(self) -> None:
        """The keeper has ended, and with it all it kept."""
        self._loop.remove_reader(self._pidfd)
        os.close(self._pidfd)
        self._loop.remove_reader(self._control)
        while self._read():  # What it said last.
            pass
        self._control.close()
        self._duty.close()
        code = self._keeper.wait()
        if self._status is None:
            self._status = self._duty.status
        reason = self._reason()
        if self._status is None and self.pid > 0:  # It was killed, and the program with it; not what that had started.
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self.pid, signal.SIGKILL)
        if self._watch is not None:
            self._watch.close()
        if self.input is not None:
            self.input.close()
        self._fail(f"its keeper ended with code {code}")
        self._open = len(self._outputs)
        for output in self._outputs:
            output.close(functools.partial(self._all_said, reason))

    def _all_said(self, reason: ExitReason) -> None:
        """One of its outputs has nothing more."""
        self._open -= 1
        if not self._open and not self.ended.done():
            self.ended.set_result(reason)

    def _reason(self) -> ExitReason:
        status = self._status
        if self._killed_for is not None:
            return self._killed_for
        if status is None:
            return Signal(signal.SIGKILL)  # As its keeper.
        if os.WIFSIGNALED(status):
            number = os.WTERMSIG(status)
            if number == signal.SIGKILL and oom_kills() > self._oom_before:
                return OutOfMemory("killed by the kernel")
            return Signal(number)
        code = os.waitstatus_to_exitcode(status)
        return Exited(code) if code else NORMAL

    def hung(self, seconds: float) -> None:
        """Kill the program; this never happens, since programs have no heartbeat."""
        self.kill(Hung(seconds))


def keeper_command(control: int, order: int) -> list[str]:
    """What to exec: without `site` and the user's settings, for neither is needed and both take time."""
    return [sys.executable, "-I", "-S", os.path.abspath(reaper.__file__), str(control), str(order), str(os.getpid())]


def _own_limits(limits: Limits | None) -> dict[str, int]:
    """What the program's process sets for itself."""
    if limits is None:
        return {}
    wanted = {name: getattr(limits, name) for name in ("address_space_bytes", "open_files", "niceness")}
    return {name: value for name, value in wanted.items() if value}


def _input_pipe(undo: contextlib.ExitStack, theirs: contextlib.ExitStack) -> tuple[int, int]:
    out, into = os.pipe2(os.O_CLOEXEC)
    undo.callback(os.close, into)
    theirs.callback(os.close, out)
    os.set_blocking(into, False)
    return out, into


def _pipe(undo: contextlib.ExitStack, theirs: contextlib.ExitStack) -> tuple[int, int]:
    out, into = os.pipe2(os.O_CLOEXEC)
    undo.callback(os.close, out)
    theirs.callback(os.close, into)
    os.set_blocking(out, False)  # our end only: the program must not fail with EAGAIN
    return out, into
