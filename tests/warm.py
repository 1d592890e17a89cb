"""Fork servers that are forked from a warm process, where users' are started by exec.

Each system with actors in processes starts a fork server, which takes a quarter of a second of a processor to import
what it needs: half of all that the tests do. So one process for each run of pytest has that imported already, and forks
what `ForkServer` would exec: a process in a session of its own, with the descriptors, the environment, the limits and
the parent that it would have, which then runs `boot.py`. What they share is what is imported, and the seed of hashes.

Started by exec are those of the tests of the fork server itself (`tests/actors/process/test_forkserver.py` and others
that say so with the fixture `cold_fork_servers`), of every program that a test starts, and all with `HOLDFAST_COLD=1`.
So are those with another interpreter, other flags of Python, or another setting of what is read as a program starts.

Tests that start programs again and again, which also import holdfast first and start a fork server of their own, say so
with `pytest.mark.usefixtures("warm_programs")`: what `subprocess` would start there with our interpreter and no option
of Python is forked from the warm process, too, and so are the fork servers of those programs.

Run as a program, this is the warm process.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import importlib
import importlib.util
import inspect
import json
import os
import resource
import runpy
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import traceback
from asyncio.base_subprocess import BaseSubprocessTransport
from collections.abc import Callable, Generator
from types import ModuleType
from typing import Any, NoReturn

import psutil
import uvloop

MODULES = (
    "holdfast.system.worker_main", "holdfast.actors.process.fork.zygote", "holdfast.ftm.replica.replica",
    "pytest", "hypothesis", "psutil", "uvloop",
)  # fmt: skip
"""What nearly every fork server of the tests imports."""
OF_COMMANDS = ("typer", "rich.console", "holdfast.console.commands")
"""The same of the command line, where that is installed."""
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
IMPORT_PATH: list[str] = []
"""Where the interpreter found modules as the warm process was started."""


def own_children() -> list[psutil.Process]:
    """The children of this process, but for the warm one."""
    return [child for child in psutil.Process().children() if child.pid not in WARM]


def umask() -> int:
    """It can be asked only by setting it."""
    found = os.umask(0o077)
    os.umask(found)
    return found


def bury() -> None:
    """Wait for children that have ended and that nobody waits for; for between tests.

    What a program had started outlives it, and is adopted by whoever has another one forked at that moment.
    """
    with contextlib.suppress(ChildProcessError):
        while (found := os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)) and found.si_pid not in WARM:
            os.waitpid(found.si_pid, os.WNOHANG)


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
    """A warm process, seen from the one that it forks for: `exec_server` stands in place of `launch.exec_server`."""

    def __init__(self) -> None:
        from holdfast.actors.process.fork import launch

        self._launch = launch
        self._command = self._flags(launch.server_command(0))
        self._at_start = _at_start(launch.server_environment())
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._control.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, PACKET_BYTES)
        self._owner = os.getpid()
        self._is_ready = False
        self._lock = threading.Lock()
        with theirs:
            self._pid = self._begin(theirs)
        WARM.add(self._pid)

    def _begin(self, theirs: socket.socket) -> int:
        """Start the warm process, which imports what it needs; its pid."""
        from holdfast.actors.process.fork import boot

        config = self._launch.server_config("", [])
        begin = {"boot": os.path.abspath(boot.__file__), "path": config.path}
        begin |= {"package": config.package, "package_path": config.package_path}
        self._control.send(json.dumps(begin).encode())
        started = subprocess.Popen(
            [*self._command, os.path.abspath(__file__), str(theirs.fileno())],
            stdin=subprocess.DEVNULL,
            pass_fds=(theirs.fileno(),),
            env=self._launch.server_environment(),
            start_new_session=True,
        )
        started.returncode = 0  # It is waited for in `close`.
        return started.pid

    def exec_server(self, control_fd: int) -> Any:
        """A fork server, as our child; by exec if a warm one would be another."""
        command, environment = self._launch.server_command(control_fd), self._launch.server_environment()
        if self._flags(command) != self._command or not self._is_like_ours(environment):
            return self._launch.exec_server(control_fd)
        order = {"server": command[-2], "environment": environment, "folder": os.getcwd()}
        with open(os.devnull, "r+b") as nothing:
            streams = [nothing.fileno() if self._launch.inherited(fd) is not None else fd for fd in (1, 2)]
            return Forked(self._order(order, [nothing.fileno(), *streams, control_fd]))

    def exec_program(
        self,
        command: list[str],
        environment: dict[str, str] | None,
        folder: str | None,
        streams: list[int],
        *,
        leads_session: bool,
    ) -> int | None:
        """A program as our child, its pid; None if it must be started by exec."""
        environment = dict(os.environ) if environment is None else environment
        own_path = os.environ.get("PYTHONPATH", "")
        if command[0] != sys.executable or not self._is_like_ours(environment | {"PYTHONPATH": own_path}):
            return None
        if len(command) < 2 or (command[1].startswith("-") and command[1] not in ("-c", "-m")):
            return None
        order = {"program": command[1:], "environment": environment, "folder": folder or os.getcwd()}
        return self._order(order | {"leads session": leads_session}, streams)

    def close(self) -> None:
        """End the warm process."""
        self._control.close()
        with contextlib.suppress(ChildProcessError):
            os.waitpid(self._pid, 0)
        WARM.discard(self._pid)

    def _flags(self, command: list[str]) -> list[str]:
        return command[: command.index("-P") + 1]

    def _is_like_ours(self, environment: dict[str, str]) -> bool:
        at_start = _at_start(self._launch.server_environment() | environment)
        return at_start == self._at_start and os.getpid() == self._owner

    def _order(self, order: dict[str, Any], fds: list[int]) -> int:
        """Have a process forked: the first three descriptors are its standard streams; its pid."""
        order |= {"umask": umask(), "limits": [[which, *resource.getrlimit(which)] for which in LIMITS]}
        with self._lock:
            if not self._is_ready and self._control.recv(100) != b"warm":
                raise RuntimeError("the warm process of the tests has not come up; HOLDFAST_COLD=1 goes without it")
            self._is_ready = True
            # Its own parent ends at once; whoever adopts it is its parent then.
            prctl(PR_SET_CHILD_SUBREAPER, 1)
            try:
                socket.send_fds(self._control, [json.dumps(order).encode()], fds)
                said = self._control.recv(100)
            finally:
                prctl(PR_SET_CHILD_SUBREAPER, 0)
        if not said:
            raise RuntimeError("the warm process of the tests has ended; HOLDFAST_COLD=1 goes without it")
        (pid,) = struct.unpack("i", said)
        assert isinstance(pid, int)
        return pid


class ServersOfAProgram(WarmServers):
    """The warm process of a program that was itself forked from one: a fork of the program, before it begins."""

    def _begin(self, theirs: socket.socket) -> int:
        pid = os.fork()
        if pid == 0:
            try:
                self._control.close()
                os.setsid()
                with open(os.devnull, "r+b", buffering=0) as nothing:
                    for fd in range(3):
                        os.dup2(nothing.fileno(), fd)
                prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
                serve(theirs)
            finally:
                os._exit(0)
        return pid


@contextlib.contextmanager
def warm_popen(warm: WarmServers) -> Generator[None]:
    """Have `subprocess` fork from the warm process what it would start with our interpreter, where that is the same."""
    by_exec: Callable[..., None] = subprocess.Popen._execute_child  # type: ignore[attr-defined]
    signature = inspect.signature(by_exec)

    def start(popen: Any, *args: Any, **kwargs: Any) -> None:
        given = signature.bind(popen, *args, **kwargs).arguments
        unusual = ("executable", "preexec_fn", "pass_fds", "shell", "gid", "gids", "uid")
        command = given["args"]
        pid = None
        is_usual = given["umask"] == given["process_group"] == -1 and not any(given[name] for name in unusual)
        if is_usual and isinstance(command, list | tuple):
            ends = zip((given["p2cread"], given["c2pwrite"], given["errwrite"]), range(3), strict=True)
            pid = warm.exec_program(
                [os.fspath(word) for word in command],
                given["env"],
                None if given["cwd"] is None else os.fspath(given["cwd"]),
                [end if end != -1 else fd for end, fd in ends],
                leads_session=given["start_new_session"],
            )
        if pid is None:
            by_exec(popen, *args, **kwargs)
            return
        popen.pid, popen._child_created = pid, True
        names = ("p2cread", "p2cwrite", "c2pread", "c2pwrite", "errread", "errwrite")
        popen._close_pipe_fds(*(given[name] for name in names))

    by_libuv = uvloop.Loop.subprocess_exec
    subprocess.Popen._execute_child = start  # type: ignore[attr-defined]
    setattr(uvloop.Loop, "subprocess_exec", subprocess_exec)  # noqa: B010  # mypy: not for a method
    try:
        yield
    finally:
        setattr(uvloop.Loop, "subprocess_exec", by_libuv)  # noqa: B010
        subprocess.Popen._execute_child = by_exec  # type: ignore[attr-defined]


async def subprocess_exec(
    loop: asyncio.AbstractEventLoop, protocol_factory: Callable[[], Any], *command: Any, **given: Any
) -> tuple[Any, Any]:
    """What the stock loop does: uvloop itself starts processes without `subprocess`."""
    protocol, begun = protocol_factory(), loop.create_future()
    given = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **given}
    transport = OfPopen(loop, protocol, command, shell=False, bufsize=0, waiter=begun, **given)

    def watch() -> None:
        status = transport.wait()
        with contextlib.suppress(RuntimeError):  # The loop is closed.
            loop.call_soon_threadsafe(transport._process_exited, status)

    threading.Thread(target=watch, daemon=True).start()
    await begun
    return transport, protocol


class OfPopen(BaseSubprocessTransport):
    """A process by `subprocess.Popen`, seen from any loop."""

    def _start(self, args: Any, shell: bool, stdin: Any, stdout: Any, stderr: Any, bufsize: int, **given: Any) -> None:
        self._proc = self._popen = subprocess.Popen(
            args, shell=shell, stdin=stdin, stdout=stdout, stderr=stderr, bufsize=bufsize, **given
        )

    def wait(self) -> int:
        return self._popen.wait()


def _at_start(environment: dict[str, str]) -> dict[str, str]:
    return {name: value for name, value in environment.items() if name.startswith(AT_START) and value}


# -- the warm process -------------------------------------------------------------------------------------------------


def warm_up(control: socket.socket) -> None:
    """Import what those need that are forked."""
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
    if importlib.util.find_spec("typer") is not None:
        for name in OF_COMMANDS:
            importlib.import_module(name)
        for place in sys.modules["holdfast.console.commands"].PLACES.values():
            importlib.import_module(f"holdfast.console.{place.partition(':')[0]}")
    import gc

    gc.collect()
    gc.freeze()


def serve(control: socket.socket) -> None:
    """Fork until whom it is done for has ended."""
    try:
        control.send(b"warm")
    except (BrokenPipeError, ConnectionResetError):  # The tests were over before we were warm.
        return
    while True:
        try:
            data, fds, _, _ = socket.recv_fds(control, PACKET_BYTES, 4)
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
    """Be as if just started, and run what was ordered."""
    try:
        if order.get("leads session", True):
            os.setsid()
        control.close()
        streams = [os.dup(fd) for fd in fds]
        for fd in fds:
            os.close(fd)
        for number, fd in enumerate(streams[:3]):
            os.dup2(fd, number)
            os.close(fd)
        os.environ.clear()
        os.environ.update(order["environment"])
        time.tzset()
        os.chdir(order["folder"])
        os.umask(order["umask"])
        for which, soft, hard in order["limits"]:
            with contextlib.suppress(ValueError, OSError):  # not ours to change
                resource.setrlimit(which, (soft, hard))
        if "program" not in order:
            serve_forks(order["server"], streams[3])
    except BaseException:
        traceback.print_exc()
        os._exit(1)
    run_program(order["program"])


def serve_forks(program: str, control: int) -> NoReturn:
    """Run `boot.py`."""
    sys.argv[:] = [program, str(control)]
    boot = importlib.import_module("holdfast.actors.process.fork.boot")
    sys.modules["__main__"] = boot
    boot.main()
    os._exit(0)


def run_program(words: list[str]) -> NoReturn:
    """Run a program as the interpreter would that is given these words, and end as it would."""
    from holdfast.actors.process.fork import fork_server

    signal.signal(signal.SIGINT, signal.default_int_handler)
    setattr(fork_server, "exec_server", ServersOfAProgram().exec_server)  # noqa: B010  # mypy: it is imported there
    main = ModuleType("__main__")
    main.__dict__["__builtins__"] = __builtins__
    sys.modules["__main__"] = main
    kind, *rest = words
    first = os.path.dirname(os.path.abspath(kind)) if kind not in ("-c", "-m") else "" if kind == "-c" else os.getcwd()
    added = [os.path.abspath(one) for one in os.environ.get("PYTHONPATH", "").split(os.pathsep) if one]
    sys.path[:] = [first, *added, *(one for one in IMPORT_PATH if one not in added)]
    try:
        if kind == "-c":
            sys.argv[:] = ["-c", *rest[1:]]
            exec(compile(rest[0], "<string>", "exec"), main.__dict__)
        elif kind == "-m":
            sys.argv[:] = ["-m", *rest[1:]]
            runpy._run_module_as_main(rest[0])  # type: ignore[attr-defined]
        else:
            sys.argv[:] = words
            main.__file__ = kind
            with open(kind, "rb") as file:
                exec(compile(file.read(), kind, "exec"), main.__dict__)
    except (SystemExit, KeyboardInterrupt):
        raise
    except BaseException as error:
        frames = error.__traceback__
        while frames is not None and frames.tb_frame.f_code.co_filename in (__file__, runpy.__file__):
            frames = frames.tb_next
        sys.excepthook(type(error), error.with_traceback(frames), frames)
        raise SystemExit(1) from None
    raise SystemExit(0)


if __name__ == "__main__":
    IMPORT_PATH[:] = sys.path
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    with socket.socket(fileno=int(sys.argv[1])) as ours:
        warm_up(ours)
        serve(ours)
    os._exit(0)
