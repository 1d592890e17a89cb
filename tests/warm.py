"""Fork servers that are forked from a warm process, where users' are started by exec.

Each system with actors in processes starts a fork server, which takes a quarter of a second of a processor to import
what it needs: half of all that the tests do. So one process for each run of pytest has that imported already, and forks
what `ForkServer` would exec: a process in a session of its own, with the descriptors, the environment, the limits and
the parent that it would have, which then runs `boot.py`. What they share is what is imported, and the seed of hashes.

Started by exec are those of the tests of the fork server itself (`tests/actors/process/test_forkserver.py` and others
that say so with the fixture `cold_fork_servers`), of every program that a test starts, and all with `HOLDFAST_COLD=1`.
So are those with another interpreter, other flags of Python, or another setting of what is read as a program starts.

Run as a program, this is the warm process.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import importlib.util
import json
import os
import resource
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from typing import Any, NoReturn

import psutil

MODULES = (
    "holdfast.system.worker_main", "holdfast.actors.process.fork.zygote", "holdfast.ftm.replica.replica",
    "pytest", "hypothesis", "psutil", "uvloop",
)  # fmt: skip
"""What nearly every fork server of the tests imports."""
AT_START = ("PYTHON", "LD_", "MALLOC_", "GLIBC_", "LC_", "LANG", "COVERAGE", "OMP_", "OPENBLAS_", "MKL_")
"""Variables that are read once, as a program or a module begins."""
LIMITS = tuple(getattr(resource, name) for name in dir(resource) if name.startswith("RLIMIT_"))
PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36
PACKET_BYTES = 1 << 20


def prctl(option: int, argument: int) -> None:
    function = ctypes.CDLL(None, use_errno=True).prctl
    function.argtypes = [ctypes.c_int, *[ctypes.c_ulong] * 4]
    if function(option, argument, 0, 0, 0):
        raise OSError(ctypes.get_errno(), "prctl")


WARM: set[int] = set()
"""The warm processes of this one."""


def own_children() -> list[psutil.Process]:
    """The children of this process, but for the warm one."""
    return [child for child in psutil.Process().children() if child.pid not in WARM]


def umask() -> int:
    """It can be asked only by setting it."""
    found = os.umask(0o077)
    os.umask(found)
    return found


class Forked:
    """A child of this process that it has not started itself: as much of a `Popen` as `ForkServer` needs."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.returncode: int | None = None

    def poll(self) -> int | None:
        return self._wait(os.WNOHANG)

    def wait(self) -> int | None:
        return self._wait(0)

    def kill(self) -> None:
        if self.poll() is None:
            os.kill(self.pid, signal.SIGKILL)

    def _wait(self, options: int) -> int | None:
        if self.returncode is None:
            try:
                pid, status = os.waitpid(self.pid, options)
            except ChildProcessError:  # as `Popen`: somebody else was first
                pid, status = self.pid, 0
            if pid:
                self.returncode = os.waitstatus_to_exitcode(status)
        return self.returncode


class WarmServers:
    """The warm process, seen from pytest: `exec_server` stands in place of `launch.exec_server`."""

    def __init__(self) -> None:
        from holdfast.actors.process.fork import boot, launch

        self._launch = launch
        command = launch.server_command(0)
        self._command = command[: command.index("-P") + 1]
        environment = launch.server_environment()
        self._at_start = _at_start(environment)
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._control.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, PACKET_BYTES)
        config = launch.server_config("", [])
        begin = {"boot": os.path.abspath(boot.__file__), "path": config.path}
        begin |= {"package": config.package, "package_path": config.package_path}
        with theirs:
            self._control.send(json.dumps(begin).encode())
            self._process = subprocess.Popen(
                [*self._command, os.path.abspath(__file__), str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                pass_fds=(theirs.fileno(),),
                env=environment,
                start_new_session=True,
            )
        WARM.add(self._process.pid)
        self._owner = os.getpid()
        self._is_ready = False
        self._lock = threading.Lock()

    def exec_server(self, control_fd: int) -> Any:
        """A fork server, as our child; by exec if a warm one would be another."""
        command, environment = self._launch.server_command(control_fd), self._launch.server_environment()
        like_ours = command[: command.index("-P") + 1] == self._command and _at_start(environment) == self._at_start
        if not like_ours or os.getpid() != self._owner:
            return self._launch.exec_server(control_fd)
        order = {
            "program": command[-2],
            "environment": environment,
            "folder": os.getcwd(),
            "umask": umask(),
            "limits": [[which, *resource.getrlimit(which)] for which in LIMITS],
        }
        with self._lock, open(os.devnull, "r+b") as nothing:
            if not self._is_ready and self._control.recv(100) != b"warm":
                raise RuntimeError("the warm process of the tests has not come up; HOLDFAST_COLD=1 goes without it")
            self._is_ready = True
            streams = [fd if self._launch.inherited(fd) is None else nothing.fileno() for fd in (1, 2)]
            # Its own parent ends at once; whoever adopts it is its parent then.
            prctl(PR_SET_CHILD_SUBREAPER, 1)
            try:
                socket.send_fds(self._control, [json.dumps(order).encode()], [*streams, control_fd])
                said = self._control.recv(100)
            finally:
                prctl(PR_SET_CHILD_SUBREAPER, 0)
        if not said:
            raise RuntimeError("the warm process of the tests has ended; HOLDFAST_COLD=1 goes without it")
        (pid,) = struct.unpack("i", said)
        return Forked(pid)

    def close(self) -> None:
        """End the warm process."""
        self._control.close()
        self._process.wait()
        WARM.discard(self._process.pid)


def _at_start(environment: dict[str, str]) -> dict[str, str]:
    return {name: value for name, value in environment.items() if name.startswith(AT_START)}


# -- the warm process -------------------------------------------------------------------------------------------------


def serve(control: socket.socket) -> None:
    """Import, then fork until pytest has ended."""
    begin = json.loads(control.recv(PACKET_BYTES))
    sys.path[:] = begin["path"]
    spec = importlib.util.spec_from_file_location("warm_boot", begin["boot"])
    assert spec is not None
    assert spec.loader is not None
    boot = importlib.util.module_from_spec(spec)
    sys.modules["warm_boot"] = boot
    spec.loader.exec_module(boot)
    boot.adopt_package(begin["package"], begin["package_path"])
    for name in MODULES:
        importlib.import_module(name)
    import gc

    gc.collect()
    gc.freeze()
    try:
        control.send(b"warm")
    except (BrokenPipeError, ConnectionResetError):  # The tests were over before we were warm.
        return
    while True:
        try:
            data, fds, _, _ = socket.recv_fds(control, PACKET_BYTES, 3)
        except ConnectionResetError:
            return
        if not data:
            return
        control.send(struct.pack("i", fork(control, json.loads(data), fds)))
        for fd in fds:
            os.close(fd)


def fork(control: socket.socket, order: dict[str, Any], fds: list[int]) -> int:
    """Fork one whose parent is the one of this process."""
    told, tell = os.pipe()
    waits, go = os.pipe()
    between = os.fork()
    if between == 0:
        pid = os.fork()
        if pid:
            os.write(tell, struct.pack("i", pid))
            os._exit(0)
        os.close(go)
        os.read(waits, 1)  # until we have another parent
        for fd in (told, tell, waits):
            os.close(fd)
        become(control, order, fds)
    (pid,) = struct.unpack("i", os.read(told, 4))
    os.waitpid(between, 0)
    for fd in (told, tell, waits, go):
        os.close(fd)
    return pid


def become(control: socket.socket, order: dict[str, Any], fds: list[int]) -> NoReturn:
    """Be as if just started, and run `boot.py`."""
    code = 1
    try:
        os.setsid()
        control.close()
        with open(os.devnull, "r+b", buffering=0) as nothing:
            os.dup2(nothing.fileno(), 0)
        os.dup2(fds[0], 1)
        os.dup2(fds[1], 2)
        ours = os.dup(fds[2])
        for fd in fds:
            os.close(fd)
        os.environ.clear()
        os.environ.update(order["environment"])
        time.tzset()
        os.chdir(order["folder"])
        os.umask(order["umask"])
        for which, soft, hard in order["limits"]:
            with contextlib.suppress(ValueError, OSError):  # not ours to change
                resource.setrlimit(which, (soft, hard))
        sys.argv[:] = [order["program"], str(ours)]
        boot = importlib.import_module("holdfast.actors.process.fork.boot")
        sys.modules["__main__"] = boot
        boot.main()
        code = 0
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        os._exit(code)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    serve(socket.socket(fileno=int(sys.argv[1])))
    os._exit(0)
