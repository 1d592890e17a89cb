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

from ...shared_memory import keep_size, unnamed
from .boot import HEADER, PAGE_BYTES, Kind
from .child_processes import signal_by

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
            socket.send_fds(control, [HEADER.pack(Kind.FORK, self.number, 0)], self._child_fds)
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
