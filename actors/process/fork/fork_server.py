"""The parent's side of the fork server: OS processes for actors, a few milliseconds each.

`ForkServer` starts the server by exec (`zygote.py` says what it does), sends it requests over a Unix socket and
sees its death through a pidfd. It touches no signal handler of the program it runs in, SIGCHLD's neither.

Source: the fork server of `multiprocessing`; the zygote of Android.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import socket
import subprocess
from collections import deque
from collections.abc import Callable, Sequence

from ...errors import ProcessUnavailable
from ...exit_reasons import Signal
from ...streams import check_can_watch
from ..owed_answer import OwedAnswer, go_on
from .boot import HEADER, PacketKind, receive
from .child_processes import signal_by
from .forked_process import SOCKET_BYTES, Forked, ForkLedger, ForkRequest, fail, has_ended
from .launch import check_can_start, exec_server, server_config

FORK_SECONDS = 10.0  # a server that does not answer by then is stopped or stuck
IMPORT_SECONDS = 120.0  # time for user modules to be imported
FORKS_IN_FLIGHT = 32  # each holds eight descriptors here, and four more on their way
PACKETS_PER_TICK = 64
AGAIN_AFTER = 0.1
"""Seconds until a socket is read again that could not be read for want of memory."""


class ForkServer:
    """Forks actor processes from one that has everything imported.

    Belongs to the event loop it is started in, stock or uvloop. When it is lost it stays lost: start another one.

    Args:
        entry: "module:function", called in each child with (socket, descriptor of the page); it returns the exit code.
        preload: names or paths of modules to import before the first fork.
        on_exit: called with (pid, wait status as from `waitpid`) when a child that `fork` has returned is dead and
            reaped, and its descendants are killed. Not called for children that end with the server.
        on_lost: called when the server has died without `stop`; its children are being killed, with what they have
            started (but for what has left their process group).
        on_stuck: called with how it was found, and what was done, when it owed an answer and a signal had stopped it.
        fork_seconds: time limit of `fork`.
    """

    def __init__(
        self,
        entry: str,
        preload: Sequence[str],
        *,
        on_exit: Callable[[int, int], None],
        on_lost: Callable[[], None],
        on_stuck: Callable[[str], None] = lambda found: None,
        fork_seconds: float = FORK_SECONDS,
    ) -> None:
        self.preload_errors: dict[str, str] = {}
        """What could not be imported, and why; "__main__" is the program itself."""
        self.is_deaf = False
        """Whether it has hung up, or did not answer in time: nothing more can be asked of it."""
        self.threads = 0
        """Threads in the server when it was ready. All but one were started by modules; a fork does not copy them."""
        self._entry, self._preload = entry, list(preload)
        self._on_exit, self._on_lost, self._on_stuck = on_exit, on_lost, on_stuck
        self._fork_seconds = fork_seconds
        self._process: subprocess.Popen[bytes] | None = None
        self._pidfd = -1
        self._control: socket.socket | None = None
        self._stopping = False
        self._ended = asyncio.Event()
        self._slots = asyncio.Semaphore(FORKS_IN_FLIGHT)
        self._outbox: deque[ForkRequest | bytes] = deque()
        self._loading = 0  # PRELOADs without an answer
        self._forks = ForkLedger()

    @property
    def pid(self) -> int:
        """The server's pid, also after its end."""
        if self._process is None:
            raise ProcessUnavailable("the fork server has not been started")
        return self._process.pid

    @property
    def died_of(self) -> str:
        """What has ended the server, as far as that is known."""
        returncode = None if self._process is None else self._process.returncode
        if returncode is None:
            return "cause unknown"
        return str(Signal(-returncode)) if returncode < 0 else f"exit code {returncode}"

    def has_ended(self) -> bool:
        """Whether the server is dead, even if the loop has not come to see it yet."""
        return self._pidfd < 0 or has_ended(self._pidfd)

    # --- starting and stopping

    async def start(self) -> None:
        """Exec the server and wait until it has imported everything.

        Raises:
            ProcessUnavailable: not on Linux, no process to be had, or the entry point cannot be imported.
        """
        check_can_start()
        if self._process is not None:
            raise ProcessUnavailable("a fork server is started once; make another one")
        self._loop = asyncio.get_running_loop()
        self._ready: asyncio.Future[None] = self._loop.create_future()
        try:
            self._exec()
            async with asyncio.timeout(IMPORT_SECONDS):
                with self._owed():
                    await self._ready
        except BaseException as error:
            await self.stop(0.0)
            if isinstance(error, TimeoutError):
                raise ProcessUnavailable(f"the fork server still imports after {IMPORT_SECONDS:g} s") from None
            if isinstance(error, OSError):
                raise ProcessUnavailable(f"the fork server cannot be started: {error}") from error
            raise

    def _exec(self) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._control = ours
        ours.setblocking(False)
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SOCKET_BYTES)
        with theirs:
            config = json.dumps(server_config(self._entry, self._preload)._asdict())
            ours.send(HEADER.pack(PacketKind.CONFIG, 0, 0) + config.encode())
            self._process = exec_server(theirs.fileno())
        try:
            self._pidfd = os.pidfd_open(self._process.pid)
            check_can_watch(self._pidfd, ours.fileno())
            self._loop.add_reader(self._pidfd, self._on_death)
        except BaseException:
            self._process.kill()  # not reaped yet, so the pid is still its own
            self._process.wait()
            if self._pidfd >= 0:  # The loop refuses it: a virtual clock waits for no process.
                os.close(self._pidfd)
                self._pidfd = -1
            raise
        self._loop.add_reader(ours.fileno(), self._on_readable)

    async def stop(self, timeout: float = 2.0) -> None:
        """End the server, which kills all its children and their descendants first; may be called twice.

        Args:
            timeout: seconds until the server itself is killed; its children then die too, and their process groups.
        """
        self._stopping = True
        self._close_control()
        self._fail_all("the fork server was stopped")
        if self._pidfd < 0:
            return
        try:
            async with asyncio.timeout(timeout):
                with self._owed():
                    await self._ended.wait()
        except TimeoutError:
            if self._pidfd >= 0:  # it may have ended in the very tick the time was up
                signal_by(self._pidfd, signal.SIGKILL)
            await self._ended.wait()

    def _owed(self) -> OwedAnswer:
        return OwedAnswer(self._loop, self.pid, self._was_stopped)

    def _was_stopped(self) -> None:
        self._on_stuck("it was stopped by a signal, and was told to go on")

    def expect_exits(self) -> None:
        """Children have ended: the server is told to go on if a signal has stopped it, so that it reaps them now."""
        if self._pidfd >= 0 and go_on(self.pid):
            self._was_stopped()

    def _on_death(self) -> None:
        """The server's pidfd is readable: it has ended."""
        assert self._process is not None
        self._loop.remove_reader(self._pidfd)  # First: whatever fails below must not bring us here again for ever.
        self._read_packets(limit=None)  # deaths it had still reported
        os.close(self._pidfd)
        self._pidfd = -1
        self._process.poll()  # reaps exactly this process; somebody else's waitpid(-1) may have been first
        self._close_control()
        self._ended.set()
        # The kernel kills the children, except one that was stopped before it could ask for that.
        for child in self._forks.children.values():
            child.kill()
            # Each leads a process group: what it had started is in it, and nobody is left to find it there.
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(child.pid, signal.SIGKILL)
        self._forks.children.clear()
        was_ready = self._ready.done() and not self._ready.cancelled() and self._ready.exception() is None
        self._fail_all(f"the fork server (pid {self._process.pid}) has died ({self.died_of})")
        if was_ready and not self._stopping:
            self._on_lost()

    def _close_control(self) -> None:
        if self._control is not None:
            if self._process is not None:
                self._loop.remove_reader(self._control.fileno())
                self._loop.remove_writer(self._control.fileno())
            self._control.close()
            self._control = None

    def _fail_all(self, problem: str) -> None:
        """Nothing will be answered any more. Requests close their descriptors when `fork` resumes."""
        self._outbox.clear()
        self._loading = 0
        self._forks.fail(problem)
        if self._process is not None:
            fail(self._ready, problem)

    # --- forking

    async def fork(self) -> Forked:
        """Start one process; calls may overlap.

        Raises:
            ProcessUnavailable: the server is gone or does not answer, or no process, memory or descriptor is left.
        """
        seconds = self._fork_seconds + (IMPORT_SECONDS if self._loading else 0.0)
        try:
            async with asyncio.timeout(seconds), self._slots:
                with self._owed():
                    return await self._fork()
        except TimeoutError:
            self.is_deaf = True
            raise ProcessUnavailable(f"the fork server (pid {self.pid}) did not answer within {seconds:g} s") from None
        except OSError as error:
            raise ProcessUnavailable(f"no process can be started: {error}") from error

    async def _fork(self) -> Forked:
        if self._control is None or not self._ready.done():
            raise ProcessUnavailable("the fork server does not run")
        request = self._forks.begin(self._loop.create_future())
        try:
            self._post(request)
            await request.outcome
            child = self._forks.hand_over(request)
            if self._ended.is_set():
                child.kill()
            return child
        finally:
            self._forks.close(request)
            if request.handed_over and request.status is not None:
                # Soon, not now: the caller must first learn of the process before it learns of its death.
                self._loop.call_soon(self._report, request.outcome.result(), request.status)

    def preload(self, module_or_path: str) -> None:
        """Import one more module in the server; processes forked from now on have it. Problems go to `preload_errors`.

        Raises:
            ProcessUnavailable: the server does not run.
        """
        if self._control is None:
            raise ProcessUnavailable("the fork server does not run")
        self._loading += 1
        self._post(HEADER.pack(PacketKind.PRELOAD, 0, 0) + module_or_path.encode())

    # --- the control socket

    def _post(self, packet: ForkRequest | bytes) -> None:
        self._outbox.append(packet)
        if len(self._outbox) == 1:
            self._flush()

    def _flush(self) -> None:
        """Send what there is, in order; come back when the socket takes more."""
        control = self._control
        if control is None:
            return
        try:
            while self._outbox:
                self._send(control, self._outbox[0])
                self._outbox.popleft()
        except BlockingIOError:
            self._loop.add_writer(control.fileno(), self._flush)
            return
        self._loop.remove_writer(control.fileno())

    def _send(self, control: socket.socket, packet: ForkRequest | bytes) -> None:
        """One packet; a failure other than "not now" is the packet's own, and its sender is told."""
        try:
            if isinstance(packet, ForkRequest):
                packet.send(control)
            else:
                control.send(packet)
        except BlockingIOError:
            raise
        except OSError as error:  # a dead server is told by its pidfd
            self.is_deaf |= isinstance(error, ConnectionError)
            if isinstance(packet, ForkRequest):
                fail(packet.outcome, f"the fork server cannot be reached: {error}")

    def _on_readable(self) -> None:
        self._read_packets(PACKETS_PER_TICK)

    def _read_packets(self, limit: int | None) -> None:
        """Handle what has arrived, at most `limit` packets: the program's own callbacks want their turn."""
        while self._control is not None and limit != 0:
            limit = None if limit is None else limit - 1
            try:
                data, fds = receive(self._control, 1)
            except BlockingIOError:
                return
            except ConnectionError:
                data, fds = b"", []
            except (OSError, MemoryError) as error:
                self._pause_reading(error)
                return
            if not data:  # its end; what that means is told by the pidfd
                self.is_deaf = True
                self._loop.remove_reader(self._control.fileno())
                return
            kind, number, value = HEADER.unpack_from(data)
            self._on_packet(PacketKind(kind), number, value, data[HEADER.size :].decode(), fds)

    def _pause_reading(self, error: OSError | MemoryError) -> None:
        """Nothing can be taken from the socket now; what is in it stays there. At once it would be as bad."""
        control = self._control
        assert control is not None
        self._loop.remove_reader(control.fileno())
        self._forks.fail(f"the fork server cannot be heard: {error!r}")
        self._loop.call_later(AGAIN_AFTER, self._read_again, control)

    def _read_again(self, control: socket.socket) -> None:
        if self._control is not control:
            return
        try:
            check_can_watch(control.fileno())
            self._loop.add_reader(control.fileno(), self._on_readable)
        except OSError as error:
            self._pause_reading(error)

    def _on_packet(self, kind: PacketKind, number: int, value: int, text: str, fds: list[int]) -> None:
        match kind:
            case PacketKind.FORKED:
                self._forks.forked(number, value, fds)
            case PacketKind.EXITED:
                if not self._forks.exited(number, value):
                    self._report(number, value)
            case PacketKind.REFUSED:
                self._forks.refused(number, text)
            case PacketKind.READY if not self._ready.done():
                self.threads = value
                self._ready.set_result(None)
            case PacketKind.BROKEN if not self._ready.done():
                self._ready.set_exception(ProcessUnavailable(f"the fork server cannot import {self._entry}: {text}"))
            case PacketKind.PROBLEM:
                name, why = json.loads(text)
                self.preload_errors[name] = why
            case PacketKind.LOADED:
                self._loading -= 1
            case _:
                pass

    def _report(self, pid: int, status: int) -> None:
        if self._forks.children.pop(pid, None) is not None:
            self._on_exit(pid, status)
