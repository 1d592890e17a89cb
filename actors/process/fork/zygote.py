"""The fork server: a process with everything imported, which forks one actor process per request.

`boot.py` has put the parent's `sys.path` in place and hands over to it. One thread, one loop, no asyncio.

What it promises
    * A child is reported with a pidfd that was opened before it could be reaped: a pid never means somebody else.
    * The descendants of an actor process die with it, those that called `setsid` too: the server is their subreaper.
    * When the parent ends, all children and descendants are killed and reaped, then the server ends. If a signal has
      stopped the server, the end of the parent has it go on.
    * When the server is killed, the kernel kills the children (PDEATHSIG), and the parent one that was stopped before
      it could ask for that; their descendants are then known to nobody.

A child pays for each page it writes to until its actor runs, some 5 us apiece: what can be done before the fork is.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import select
import signal
import socket
import sys
import traceback
import types
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, NoReturn

from .boot import (
    HEADER,
    OWNER_VARIABLE,
    PR_SET_CHILD_SUBREAPER,
    PR_SET_PDEATHSIG,
    Config,
    PacketKind,
    bind_prctl,
    receive,
)
from .child_processes import ProcessTable, send_signal
from .preload import attempt, find_entry, load, load_main

# A service manager or a terminal signals whole groups; when and how to end is for the parent to decide.
_BLOCKED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class _Request(NamedTuple):
    """The descriptors a child takes over."""

    sock: int
    stdout: int
    stderr: int
    page: int

    def close(self) -> None:
        for fd in self:
            os.close(fd)


N_FDS = len(_Request._fields)


class Zygote:
    """The loop of the fork server."""

    def __init__(self, control: socket.socket, config: Config, parent_fd: int) -> None:
        self._control = control
        self._config = config
        self._parent_fd = parent_fd
        self._pid = os.getpid()
        self._prctl = bind_prctl()
        self._table = ProcessTable(self._pid)
        self._children: dict[int, str] = {}  # forked on request and not reaped: pid -> number of the request
        self._helpers: set[int] = set()  # processes that a preloaded module started
        self._sigchld: Any = signal.SIG_DFL  # the handler of a preloaded module
        self._wake_out = self._wake_in = -1

    def run(self) -> None:
        """Prepare, then serve until the parent is gone or hangs up."""
        if not self._prepare():
            return
        self._serve()
        self._end_all()

    # preparing

    def _prepare(self) -> bool:
        """Import everything; False if the entry point cannot be had."""
        config = self._config
        try:
            self._entry = find_entry(config.entry)
            gc.enable()
        except BaseException as error:
            self._send(PacketKind.BROKEN, text=f"{type(error).__name__}: {error}")
            return False
        if config.main:
            self._load("__main__", lambda: load_main(config.main, config.main_is_path))
        for name in config.preload:
            self._load(name, lambda name=name: load(name))  # type: ignore[misc]
        self._prctl(PR_SET_CHILD_SUBREAPER, 1)
        self._settle()
        # From here on the end of the parent is an orderly one: descendants go first. We see it even if we are stopped.
        self._prctl(PR_SET_PDEATHSIG, signal.SIGCONT)
        self._send(PacketKind.READY, value=len(os.listdir("/proc/self/task")))
        return True

    def _load(self, name: str, load_it: Callable[[], None]) -> None:
        if problem := attempt(load_it):
            self._send(PacketKind.PROBLEM, text=json.dumps([name, problem[:8000]]))

    def _settle(self) -> None:
        """After importing: take the signals, freeze the heap, note the processes that belong to modules."""
        self._helpers |= {pid for pid in self._table.children(self._children) if not self._has_living_owner(pid)}
        self._take_signals()
        for stream in (sys.stdout, sys.stderr):
            # What is left in a buffer would be written by each child again. And lines must be out before a SIGKILL
            # comes: into a pipe Python would collect them.
            with contextlib.suppress(OSError, ValueError, AttributeError):
                stream.flush()
                stream.reconfigure(line_buffering=True)  # type: ignore[union-attr]
        # The children keep it frozen: a collection writes to the header of each object it visits, and with that copies
        # every page of the heap. What is imported lives as long as the process anyway.
        gc.collect()
        gc.freeze()

    def _take_signals(self) -> None:
        """Let deaths wake us and hold off the rest; handlers of preloaded modules are for the children."""
        if self._wake_in < 0:
            self._wake_out, self._wake_in = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
        signal.pthread_sigmask(signal.SIG_BLOCK, _BLOCKED)
        found = signal.signal(signal.SIGCHLD, self._on_signal)
        if found is not None and found is not self._on_signal:
            self._sigchld = found
        signal.set_wakeup_fd(self._wake_in, warn_on_full_buffer=False)

    @staticmethod
    def _on_signal(signum: int, frame: types.FrameType | None) -> None:
        """Nothing: the wake-up descriptor has been written to."""

    # serving

    def _serve(self) -> None:
        poll = select.poll()  # no descriptor of its own, which children would have to close
        for fd in (self._control.fileno(), self._parent_fd, self._wake_out):
            poll.register(fd, select.POLLIN)
        while True:
            ready = {fd for fd, _ in poll.poll()}
            if self._wake_out in ready:
                self._on_children()
            if self._control.fileno() in ready and not self._on_packet():
                return
            if self._parent_fd in ready:
                return

    def _on_packet(self) -> bool:
        """Do what the parent asks; False at its end."""
        try:
            data, fds = receive(self._control, N_FDS)
        except ConnectionError:
            return False
        if not data:
            return False
        kind, number, _ = HEADER.unpack_from(data)
        if kind == PacketKind.FORK:
            self._fork(number, fds)
        elif kind == PacketKind.PRELOAD:
            name = data[HEADER.size :].decode()
            self._load(name, lambda: load(name))
            self._settle()
            self._send(PacketKind.LOADED)
        return True

    def _send(self, kind: PacketKind, number: int = 0, value: int = 0, text: str = "", fds: Sequence[int] = ()) -> None:
        # A parent that does not read holds us up, which is right; one that is gone is noticed by the loop.
        with contextlib.suppress(ConnectionError):
            socket.send_fds(self._control, [HEADER.pack(kind, number, value), text.encode(errors="replace")], fds)

    def _fork(self, number: int, fds: list[int]) -> None:
        if len(fds) != N_FDS:  # the kernel drops what does not fit into our descriptor table
            self._refuse(number, fds, "the fork server is out of file descriptors")
            return
        request = _Request(*fds)
        sock = socket.socket(fileno=request.sock)
        os.environ[OWNER_VARIABLE] = str(number)
        try:
            pid = os.fork()
        except OSError as error:
            sock.detach()
            self._refuse(number, fds, f"fork: {error.strerror}")
            return
        if pid == 0:
            self._be_child(request, sock)
        self._children[pid] = str(number)
        self._announce(number, pid)
        sock.detach()
        request.close()

    def _announce(self, number: int, pid: int) -> None:
        """Hand the parent a descriptor of the child. Nothing is reaped meanwhile: reaping is done by this same loop."""
        try:
            pidfd = os.pidfd_open(pid)
        except OSError as error:
            send_signal(pid, signal.SIGKILL)
            self._refuse(number, (), f"pidfd_open: {error.strerror}")
            return
        self._send(PacketKind.FORKED, number, pid, fds=(pidfd,))
        os.close(pidfd)

    def _refuse(self, number: int, fds: Sequence[int], why: str) -> None:
        for fd in fds:
            os.close(fd)
        self._send(PacketKind.REFUSED, number, text=why)

    # deaths

    def _on_children(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.read(self._wake_out, 4096)
        while gone := self._reap():
            ours = [(pid, status) for pid, status in gone if pid in self._children]
            self._forget(gone)
            # First the descendants, then the report: who starts the actor anew must not find its port still taken.
            self._kill_strays()
            for pid, status in ours:
                self._send(PacketKind.EXITED, pid, status)

    def _reap(self) -> list[tuple[int, int]]:
        """Take the wait status of all that have died."""
        gone: list[tuple[int, int]] = []
        with contextlib.suppress(ChildProcessError):
            while (found := os.waitpid(-1, os.WNOHANG))[0]:
                gone.append(found)
        return gone

    def _forget(self, gone: list[tuple[int, int]]) -> None:
        for pid, _ in gone:
            self._children.pop(pid, None)
            self._helpers.discard(pid)

    def _kill_strays(self) -> None:
        """Kill what a dead child has left; its own children come to us when it is reaped, which is another round."""
        with contextlib.suppress(ChildProcessError):
            os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)  # raises if there is no child at all
            for pid in self._table.children(self._children.keys() | self._helpers):
                if not self._has_living_owner(pid):
                    send_signal(pid, signal.SIGKILL)

    def _has_living_owner(self, pid: int) -> bool:
        """Whether an adopted process is a daemon of a child that lives: its parent ended, the child did not.

        Told by session, or by the environment of the program. One that has left the session without an exec cannot be
        told, and is taken for a dead child's.
        """
        try:
            if os.getsid(pid) in self._children:
                return True
            with open(f"/proc/{pid}/environ", "rb") as file:
                variables = file.read().split(b"\0")
        except OSError:
            return False
        prefix = f"{OWNER_VARIABLE}=".encode()
        owners = [variable[len(prefix) :].decode() for variable in variables if variable.startswith(prefix)]
        return any(owner in self._children.values() for owner in owners)

    def _end_all(self) -> None:
        """Kill and reap until no child is left, of us or of anybody below."""
        with contextlib.suppress(ChildProcessError):
            while True:
                for pid in (*self._children, *self._table.children(self._children)):
                    send_signal(pid, signal.SIGKILL)
                self._forget([os.waitpid(-1, 0), *self._reap()])

    # the child

    def _be_child(self, request: _Request, sock: socket.socket) -> NoReturn:
        """Become an actor process; does not return. Nothing of the server may survive in it."""
        code = 1
        try:
            signal.set_wakeup_fd(-1)  # first: a signal to the child would wake the server
            self._leave_server(request)
            code = self._entry(sock, request.page) or 0
        except SystemExit as leaving:
            code = leaving.code if isinstance(leaving.code, int) else int(leaving.code is not None)
        except BaseException:
            traceback.print_exc()
        finally:
            for stream in (sys.stdout, sys.stderr):
                with contextlib.suppress(Exception):
                    stream.flush()
            os._exit(code & 0xFF)

    def _leave_server(self, request: _Request) -> None:
        self._prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != self._pid:  # the server died before the kernel knew what to do then
            os._exit(1)
        os.setsid()
        os.dup2(request.stdout, 1)  # standard input is /dev/null since the server's exec
        os.dup2(request.stderr, 2)
        # By name, not all above 2: a preloaded module may hold a file, and its number must not come to mean our socket.
        ours = (self._control.detach(), self._parent_fd, self._wake_out, self._wake_in)
        for fd in (*ours, request.stdout, request.stderr):
            os.close(fd)
        signal.signal(signal.SIGCHLD, self._sigchld)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _BLOCKED)
        if "numpy.random" in sys.modules:  # it would repeat itself in each child; `random` reseeds itself after a fork
            sys.modules["numpy.random"].seed()
