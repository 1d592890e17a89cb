"""One forked process as the parent has it: what is asked of the fork server, and what comes of it."""

from __future__ import annotations

import asyncio
import contextlib
import mmap
import os
import select
import signal
import socket
from dataclasses import dataclass
from typing import Any

from ...errors import ProcessUnavailable
from ...shared_memory import keep_size, unnamed
from .boot import HEADER, PAGE_BYTES, PacketKind
from .child_processes import parent_of, signal_by

SOCKET_BYTES = 2 * 1024 * 1024


@dataclass(slots=True)
class Forked:
    """One actor process, seen from the root.

    Who hands a descriptor on (to a transport that will close it) sets the field to -1; `close` closes what is left.

    Attributes:
        sock: our end of the socket pair, non-blocking.
        page: memory shared with the child; readable after its death, however it died.
    """

    pid: int
    pidfd: int
    sock: socket.socket
    stdout_fd: int
    stderr_fd: int
    page: mmap.mmap

    def kill(self, signum: int | None = None) -> bool:
        """Send a signal, SIGKILL if left out, to this very process; nothing happens if it is dead already.

        Returns whether that could be.
        """
        return self.pidfd < 0 or signal_by(self.pidfd, signal.SIGKILL if signum is None else signum)

    def owns(self, pid: int) -> bool:
        """Whether a process is this one or a child of it, so that this one may name its memory."""
        return self.pid in (pid, parent_of(pid))

    def close(self) -> None:
        """Give everything back; may be called twice. The process sees the end of its socket."""
        self.sock.close()
        for fd in (self.pidfd, self.stdout_fd, self.stderr_fd):
            if fd >= 0:
                os.close(fd)
        self.pidfd = self.stdout_fd = self.stderr_fd = -1
        self.page.close()


def has_ended(pidfd: int) -> bool:
    """Whether the process behind a pidfd is dead, now."""
    poll = select.poll()
    poll.register(pidfd, select.POLLIN)
    return bool(poll.poll(0))


class ForkRequest:
    """A fork that was asked for: our ends of everything, the child's ends until they are sent, and the outcome."""

    def __init__(self, number: int, outcome: asyncio.Future[int]) -> None:
        self.number = number
        self.outcome = outcome  # the child's pid
        self.pidfd = -1
        self.status: int | None = None  # wait status, if it died before anybody had it
        self.handed_over = False
        self._child_fds: list[int] = []
        with contextlib.ExitStack() as undo:
            self.sock, theirs = socket.socketpair()
            undo.callback(self.sock.close)
            undo.callback(theirs.close)
            self._set_up(self.sock, theirs)
            self.stdout_fd, stdout = self._pipe(undo)
            self.stderr_fd, stderr = self._pipe(undo)
            page_fd = unnamed("holdfast-page")
            undo.callback(os.close, page_fd)
            os.ftruncate(page_fd, PAGE_BYTES)
            keep_size(page_fd)
            self.page = mmap.mmap(page_fd, PAGE_BYTES)
            undo.pop_all()
        self._child_fds = [theirs.detach(), stdout, stderr, page_fd]

    @staticmethod
    def _set_up(ours: socket.socket, theirs: socket.socket) -> None:
        ours.setblocking(False)
        for sock in (ours, theirs):
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SOCKET_BYTES)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SOCKET_BYTES)

    @staticmethod
    def _pipe(undo: contextlib.ExitStack) -> tuple[int, int]:
        out, into = os.pipe2(os.O_CLOEXEC)
        undo.callback(os.close, out)
        undo.callback(os.close, into)
        os.set_blocking(out, False)  # our end only: a child's print() must not fail with EAGAIN
        return out, into

    def send(self, control: socket.socket) -> None:
        """Ask the server; raises BlockingIOError if it must be tried again."""
        if self._child_fds:  # otherwise nobody waits any more
            socket.send_fds(control, [HEADER.pack(PacketKind.FORK, self.number, 0)], self._child_fds)
            self._close_child_fds()

    def _close_child_fds(self) -> None:
        for fd in self._child_fds:
            os.close(fd)
        self._child_fds = []

    def hand_over(self) -> Forked:
        """The process, now the caller's."""
        self.handed_over = True
        return Forked(self.outcome.result(), self.pidfd, self.sock, self.stdout_fd, self.stderr_fd, self.page)

    def abandon(self) -> None:
        """Nobody wants it: kill what there may be, close everything."""
        self._close_child_fds()
        done = Forked(-1, self.pidfd, self.sock, self.stdout_fd, self.stderr_fd, self.page)
        done.kill()
        done.close()
        self.pidfd = -1


class ForkLedger:
    """The forks that were asked for, and the processes that came of them."""

    def __init__(self) -> None:
        self._last_number = 0
        self._requests: dict[int, ForkRequest] = {}  # by number, unanswered
        self._unclaimed: dict[int, ForkRequest] = {}  # by pid, answered, whoever asked has not resumed yet
        self.children: dict[int, Forked] = {}  # by pid, what was handed over

    def begin(self, outcome: asyncio.Future[int]) -> ForkRequest:
        """One more is asked for."""
        self._last_number += 1
        request = self._requests[self._last_number] = ForkRequest(self._last_number, outcome)
        return request

    def forked(self, number: int, pid: int, fds: list[int]) -> None:
        """The server has made a process; `fds` is its pidfd, if there was a descriptor free for it."""
        request = self._requests.pop(number, None)
        if request is None or request.outcome.done():  # given up meanwhile
            for fd in fds:
                signal_by(fd, signal.SIGKILL)
                os.close(fd)
        elif not fds:  # no descriptor was free here; the child ends with its socket
            fail(request.outcome, "no process can be started: out of file descriptors")
        else:
            request.pidfd = fds[0]
            self._unclaimed[pid] = request
            request.outcome.set_result(pid)

    def refused(self, number: int, why: str) -> None:
        """The server could make no process."""
        request = self._requests.pop(number, None)
        if request is not None:
            fail(request.outcome, f"no process can be started: {why}")

    def exited(self, pid: int, status: int) -> bool:
        """A process is dead. Returns whether whoever asked for it has not had it yet: then the request remembers it."""
        request = self._unclaimed.pop(pid, None)
        if request is not None:
            request.status = status
        return request is not None

    def hand_over(self, request: ForkRequest) -> Forked:
        """The process that came of a request, now the caller's."""
        child = self.children[request.outcome.result()] = request.hand_over()
        return child

    def close(self, request: ForkRequest) -> None:
        """Whoever asked has resumed: it has the process now, or nobody has."""
        self._requests.pop(request.number, None)
        outcome = request.outcome
        if outcome.done() and not outcome.cancelled() and outcome.exception() is None:
            self._unclaimed.pop(outcome.result(), None)
        if not request.handed_over:
            request.abandon()

    def fail(self, problem: str) -> None:
        """Nothing that is asked for comes. Each request closes its descriptors when whoever asked resumes."""
        for request in self._requests.values():
            fail(request.outcome, problem)


def fail(future: asyncio.Future[Any], problem: str) -> None:
    """End a wait, unless it is over. Whoever waited may have been cancelled: asyncio need not complain of it."""
    if not future.done():
        future.set_exception(ProcessUnavailable(problem))
        future.exception()
