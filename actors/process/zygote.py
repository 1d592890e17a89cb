"""The fork server: a process with everything imported, which forks one actor process per request.

It is run as a file by `ForkServer` (`forkserver.py`) and imports the standard library only, so that it can put the
parent's `sys.path` in place before anything of holdfast or of the user is imported. One thread, one loop, no asyncio.

What it promises
    * A child is reported with a pidfd that was opened before it could be reaped: a pid never means somebody else.
    * The descendants of an actor process die with it, those that called `setsid` too: the server is their subreaper.
    * When the parent ends, all children and descendants are killed and reaped, then the server ends.
    * When the server is killed, the kernel kills the children (PDEATHSIG); their descendants are then known to nobody.

A child pays for each page it writes to until its actor runs, some 5 us apiece: what can be done before the fork is.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import importlib.abc
import importlib.util
import json
import os
import select
import signal
import socket
import struct
import sys
import traceback
import types
from collections.abc import Callable, Collection, Iterator, Sequence
from enum import IntEnum
from typing import Any, NamedTuple, NoReturn

HEADER = struct.Struct("<BIi")  # kind, number, value; a text may follow
PACKET_BYTES = 64 * 1024  # a packet is header and text; longer texts are cut
PAGE_BYTES = 4096
SERVER_VARIABLE = "HOLDFAST_FORK_SERVER"  # pid of the fork server, set in it and seen by all its descendants
OWNER_VARIABLE = "HOLDFAST_PROCESS"  # number of the actor process, set in it and seen by the programs it starts
MAIN_NAME = "__mp_main__"  # the name scripts already know from multiprocessing

_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36
# A service manager or a terminal signals whole groups; when and how to end is for the parent to decide.
_BLOCKED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Kind(IntEnum):
    """What a packet says; (number, value) in brackets, then the text."""

    CONFIG = 1  # to the server, first and once: text = Config as JSON
    FORK = 2  # to the server (request): with socket, stdout, stderr and page
    PRELOAD = 3  # to the server: text = a module's name or path
    READY = 4  # to the parent (, threads): everything is imported
    BROKEN = 5  # to the parent: the entry point cannot be had; text = why
    PROBLEM = 6  # to the parent: a preload failed; text = [what, why] as JSON
    LOADED = 7  # to the parent: one PRELOAD is done, well or not
    FORKED = 8  # to the parent (request, pid): with the child's pidfd
    REFUSED = 9  # to the parent (request): no child; text = why
    EXITED = 10  # to the parent (pid, wait status)


class Config(NamedTuple):
    """What the server must know of its parent; travels as JSON."""

    parent: int
    entry: str
    preload: list[str]
    path: list[str]
    argv: list[str]
    package: str
    package_path: list[str]
    main: str  # module name or path of the program, "" for none
    main_is_path: bool


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


def receive(control: socket.socket, max_fds: int) -> tuple[bytes, list[int]]:
    """One packet, with the descriptors that came along.

    `socket.recv_fds` loses its `flags` argument (Python 3.11): descriptors would leak into programs that actors start.
    """
    space = socket.CMSG_LEN(max_fds * struct.calcsize("i"))
    data, ancillary, _, _ = control.recvmsg(PACKET_BYTES, space, socket.MSG_CMSG_CLOEXEC)
    fds: list[int] = []
    for level, kind, payload in ancillary:
        if level == socket.SOL_SOCKET and kind == socket.SCM_RIGHTS:
            fds += struct.unpack(f"{len(payload) // struct.calcsize('i')}i", payload)
    return data, fds


# --- importing


def adopt_package(name: str, paths: list[str]) -> None:
    """Make `name` importable from the very directory the parent has it from.

    An editable install is found through a finder, which `sys.path` does not show, and its directory has any name.
    """
    found = importlib.util.find_spec(name)
    if found is not None and list(found.submodule_search_locations or ()) == paths:
        return
    init = os.path.join(paths[0], "__init__.py")
    spec = importlib.util.spec_from_file_location(name, init, submodule_search_locations=paths)
    if spec is None or spec.loader is None:
        raise ImportError(f"cannot load package {name} from {init}")
    sys.modules[name] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)


def find_entry(entry: str) -> Callable[[socket.socket, int], int | None]:
    """Import "module:function"."""
    module, _, function = entry.partition(":")
    found: Callable[[socket.socket, int], int | None] = getattr(importlib.import_module(module), function)
    return found


def load(what: str) -> None:
    """Import a module by name, or a file by its path (as the module named like the file)."""
    if os.sep not in what and not what.endswith(".py"):
        importlib.import_module(what)
        return
    name = os.path.splitext(os.path.basename(what))[0]
    if name in sys.modules:
        known = getattr(sys.modules[name], "__file__", None)
        if known is None or not os.path.samefile(known, what):
            raise ImportError(f"another module is called {name} already ({known or 'built in'})")
        return
    spec = importlib.util.spec_from_file_location(name, what)
    if spec is None or spec.loader is None:
        raise ImportError(f"{what} is not a Python file")
    sys.modules[name] = module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise


def load_main(main: str, is_path: bool) -> None:
    """Run the parent's program under another name, so that classes defined in it are found as `__main__:X`.

    As multiprocessing's spawn does, but the module's namespace is the one its functions see: `runpy` hands out a copy.
    """
    module = types.ModuleType(MAIN_NAME)
    if is_path:
        module.__file__ = main
        with open(main, "rb") as file:
            code = compile(file.read(), main, "exec", dont_inherit=True)
    else:
        spec = importlib.util.find_spec(main)
        if spec is None or not isinstance(spec.loader, importlib.abc.InspectLoader):
            raise ImportError(f"no module named {main}")
        module.__file__, module.__package__ = spec.origin, spec.parent
        found = spec.loader.get_code(main)
        if found is None:
            raise ImportError(f"{main} has no Python code")
        code = found
    replaced = sys.modules["__main__"]
    sys.modules["__main__"] = sys.modules[MAIN_NAME] = module
    try:
        exec(code, module.__dict__)
    except BaseException:
        sys.modules["__main__"] = replaced
        del sys.modules[MAIN_NAME]
        raise


def attempt(load_it: Callable[[], None]) -> str:
    """Run one import; what went wrong, or an empty string."""
    try:
        load_it()
    except BaseException as error:  # a module may well call sys.exit(): that must not end the server
        frames = traceback.extract_tb(error.__traceback__)
        where = f" ({frames[-1].filename}:{frames[-1].lineno})" if frames else ""
        return f"{type(error).__name__}: {error}{where}"
    return ""


# --- processes


def bind_prctl() -> Callable[[int, int], None]:
    """`prctl(option, argument)`, looked up once, before any fork."""
    import ctypes

    function = ctypes.CDLL(None, use_errno=True).prctl
    function.argtypes, function.restype = [ctypes.c_int, *[ctypes.c_ulong] * 4], ctypes.c_int

    def prctl(option: int, argument: int) -> None:
        if function(option, argument, 0, 0, 0):
            number = ctypes.get_errno()
            raise OSError(number, f"prctl({option}): {os.strerror(number)}")

    return prctl


def send_signal(pid: int, signum: int) -> None:
    """Signal a child of ours. Not reaped yet, so its pid is still its own; it may be a zombie, which is no error."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signum)


def parent_of(pid: int) -> int:
    """Parent's pid, or -1 when the process is gone."""
    try:
        with open(f"/proc/{pid}/stat", "rb", buffering=0) as file:
            return int(file.read(4096).rpartition(b")")[2].split()[1])
    except (OSError, IndexError):
        return -1


class ProcessTable:
    """Finds our own children, the adopted ones included.

    The kernel has a list for that (`/proc/self/task/*/children`) only if built with CONFIG_PROC_CHILDREN. Without it we
    look through all of /proc. A process that is not our descendant never becomes one, so it is looked at once and
    remembered by pid and inode; a pid that is used again has a new inode. Looking thus costs one directory listing.
    """

    def __init__(self, me: int) -> None:
        self._me = me
        self._has_list = os.path.exists(f"/proc/self/task/{me}/children")
        self._foreign: dict[int, int] = {}  # pid -> inode of its directory in /proc

    def children(self, known: Collection[int]) -> list[int]:
        """Pids of our children apart from `known`.

        One that is adopted while we look may be missed: the death that brought it here wakes us again.
        """
        found = self._listed() if self._has_list else self._searched(known)
        return [pid for pid in found if pid not in known]

    def _listed(self) -> Iterator[int]:
        for task in os.listdir("/proc/self/task"):
            with contextlib.suppress(OSError), open(f"/proc/self/task/{task}/children", "rb") as file:
                yield from map(int, file.read().split())

    def _searched(self, known: Collection[int]) -> list[int]:
        with os.scandir("/proc") as entries:
            listed = {int(entry.name): entry.inode() for entry in entries if entry.name.isdecimal()}
        foreign = {pid: inode for pid, inode in self._foreign.items() if listed.get(pid) == inode}
        parents = {pid: parent_of(pid) for pid in listed if pid not in foreign and pid not in known and pid != self._me}
        remembered = set(foreign)
        foreign |= {pid: listed[pid] for pid in parents if self._is_foreign(pid, parents, remembered)}
        self._foreign = foreign
        return [pid for pid, parent in parents.items() if parent == self._me]

    def _is_foreign(self, pid: int, parents: dict[int, int], foreign: set[int]) -> bool:
        """Whether the ancestors lead past us. A missing link says nothing: it may have been a descendant of ours."""
        for _ in range(len(parents)):  # parents are read one by one and may form a ring by reuse of a pid
            pid = parents.get(pid, -1)
            if pid == 0 or pid in foreign:
                return True
            if pid == -1:
                return False
        return False


# --- the server


class Zygote:
    """The loop of the fork server."""

    def __init__(self, control: socket.socket, config: Config) -> None:
        self._control = control
        self._config = config
        self._pid = os.getpid()
        self._prctl = bind_prctl()
        self._table = ProcessTable(self._pid)
        self._children: dict[int, str] = {}  # forked on request and not reaped: pid -> number of the request
        self._helpers: set[int] = set()  # processes that a preloaded module started
        self._sigchld: Any = signal.SIG_DFL  # the handler of a preloaded module
        self._parent_fd = -1
        self._wake_out = self._wake_in = -1

    def run(self) -> None:
        """Prepare, then serve until the parent is gone or hangs up."""
        if not self._watch_parent() or not self._prepare():
            return
        self._serve()
        self._end_all()

    # preparing

    def _watch_parent(self) -> bool:
        # While modules are imported nobody looks at the socket; there are no children yet, so being killed is fine.
        self._prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        # The end of the socket is not enough: a process the parent forked without exec holds a copy of the other end.
        self._parent_fd = os.pidfd_open(self._config.parent)
        return os.getppid() == self._config.parent

    def _prepare(self) -> bool:
        """Import everything; False if the entry point cannot be had."""
        config = self._config
        os.environ[SERVER_VARIABLE] = str(self._pid)
        sys.path[:], sys.argv[:] = config.path, config.argv
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell that started us with & has it ignored
        try:
            adopt_package(config.package, config.package_path)
            self._entry = find_entry(config.entry)
        except BaseException as error:
            self._send(Kind.BROKEN, text=f"{type(error).__name__}: {error}")
            return False
        if config.main:
            self._load("__main__", lambda: load_main(config.main, config.main_is_path))
        for name in config.preload:
            self._load(name, lambda name=name: load(name))  # type: ignore[misc]
        self._prctl(_PR_SET_CHILD_SUBREAPER, 1)
        self._settle()
        self._prctl(_PR_SET_PDEATHSIG, 0)  # from here on the end of the parent is an orderly one: descendants go first
        self._send(Kind.READY, value=len(os.listdir("/proc/self/task")))
        return True

    def _load(self, name: str, load_it: Callable[[], None]) -> None:
        if problem := attempt(load_it):
            self._send(Kind.PROBLEM, text=json.dumps([name, problem[:8000]]))

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
        if kind == Kind.FORK:
            self._fork(number, fds)
        elif kind == Kind.PRELOAD:
            name = data[HEADER.size :].decode()
            self._load(name, lambda: load(name))
            self._settle()
            self._send(Kind.LOADED)
        return True

    def _send(self, kind: Kind, number: int = 0, value: int = 0, text: str = "", fds: Sequence[int] = ()) -> None:
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
        self._send(Kind.FORKED, number, pid, fds=(pidfd,))
        os.close(pidfd)

    def _refuse(self, number: int, fds: Sequence[int], why: str) -> None:
        for fd in fds:
            os.close(fd)
        self._send(Kind.REFUSED, number, text=why)

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
                self._send(Kind.EXITED, pid, status)

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
        self._prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
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


def main() -> None:
    """Entry of the exec'd process: `zygote.py <descriptor of the control socket>`."""
    signal.pthread_sigmask(signal.SIG_SETMASK, ())  # the parent's mask outlives exec; without SIGCHLD we reap nothing
    control = socket.socket(fileno=int(sys.argv[1]))
    control.set_inheritable(False)
    packet = control.recv(1 << 20)
    if packet:  # otherwise the parent ended at once
        Zygote(control, Config(**json.loads(packet[HEADER.size :]))).run()


if __name__ == "__main__":
    main()
    # Threads and exit handlers of preloaded modules are no reason to stay, or to do anything: the work is done.
    os._exit(0)
