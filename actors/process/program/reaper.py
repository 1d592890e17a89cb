"""The keeper of one external program: a small process that owns the program on behalf of its actor.

It is run as a file (`external_program.py` does that) and imports next to nothing, so that it starts in some 15 ms.

What it promises
    * The program leads a session of its own and is ended, with all its descendants (those that called `setsid` too: the
      keeper is their subreaper), when its owner's process ends, however that ends, SIGKILL included.
    * The end of the program is told when nothing of it is left: who starts it anew finds its port free.
    * If a signal has stopped the keeper, the end of its owner's process has it go on.
    * If the keeper itself is killed, the kernel kills the program (PDEATHSIG; the keeper has one thread, so the signal
      cannot come too early), and the owner the rest of its process group.
    * A program that has become another user may be out of its reach. Then it says so, stays, and tells of the end that
      the program finds by itself, or by somebody who may.
"""

from __future__ import annotations

import ctypes
import marshal
import os
import select
import sys

TYPE_CHECKING = False  # importing `typing`, or `signal` with its enums, would take as long as all the rest
if TYPE_CHECKING:
    import signal
    from typing import Any, NoReturn
else:
    import _signal as signal

STARTED, FAILED, ENDED = b"S", b"F", b"E"  # to the owner: pid; why not; wait status
DENIED = b"D"  # to the owner: why SIGKILL is refused; the keeper goes on. The end of the socket means SIGKILL for all.

PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36
LIMITS = {"address_space_bytes": 9, "open_files": 7}  # RLIMIT_AS, RLIMIT_NOFILE

# A service manager or a terminal signals whole groups; when and how the program ends is for its owner to decide.
_IGNORED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
_RESTORED = (*_IGNORED, signal.SIGPIPE, signal.SIGXFSZ)  # Python ignores the last two


def prctl(option: int, argument: int) -> None:
    """The system call. Raises OSError."""
    function = ctypes.CDLL(None, use_errno=True).prctl
    function.argtypes, function.restype = [ctypes.c_int, *[ctypes.c_ulong] * 4], ctypes.c_int
    if function(option, argument, 0, 0, 0):
        number = ctypes.get_errno()
        raise OSError(number, f"prctl({option}): {os.strerror(number)}")


class Reaper:
    """The loop of the keeper: the owner's end of the socket, deaths from the kernel."""

    def __init__(self, control: int, owner: int, order: dict[str, Any]) -> None:
        """`order`: command (list of str), env (dict of str), cwd (str or None), limits (dict of int by name)."""
        self._control, self._owner, self._order = control, owner, order
        self._wake_out, wake_in = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
        for number in _IGNORED:
            signal.signal(number, signal.SIG_IGN)
        signal.signal(signal.SIGCHLD, self._on_death)
        signal.set_wakeup_fd(wake_in, warn_on_full_buffer=False)
        self._keeper, self._pid = os.getpid(), 0
        self._status: int | None = None  # of the program, once it has ended

    def _on_death(self, number: int, frame: object) -> None:
        """Nothing: the wake-up descriptor has been written to."""

    def run(self) -> None:
        """Start the program and stay until nothing of it is left."""
        prctl(PR_SET_PDEATHSIG, signal.SIGCONT)  # Stopped by a signal, we are to see the end of the owner all the same.
        owner_fd = os.pidfd_open(self._owner)
        if os.getppid() != self._owner:
            return  # It has ended already.
        prctl(PR_SET_CHILD_SUBREAPER, 1)
        why = self._start()
        if why:
            self._tell(FAILED + why)
            return
        self._tell(STARTED + b"%d" % self._pid)
        poll = select.poll()
        # The end of the socket is not enough: what the owner forked without exec holds a copy of the other end.
        for fd in (self._control, owner_fd, self._wake_out):
            poll.register(fd, select.POLLIN)
        while self._status is None:
            ready = {fd for fd, _ in poll.poll()}
            if self._wake_out in ready:
                self._reap()
            if owner_fd in ready or self._control in ready:
                break
        self._end_all()
        self._tell(ENDED + b"%d" % (self._status or 0))

    def _tell(self, packet: bytes) -> None:
        try:
            os.write(self._control, packet)
        except OSError:
            pass  # Nobody is left to be told.

    # -- the program ------------------------------------------------------------------------------------------------

    def _start(self) -> bytes:
        """Fork and exec; returns why that failed, nothing if it did not."""
        failed_out, failed_in = os.pipe2(os.O_CLOEXEC)
        self._pid = os.fork()
        if self._pid == 0:
            self._become(failed_in)
        self._let_go_of_input()
        os.close(failed_in)
        with open(failed_out, "rb") as file:
            return file.read()  # Ends with the exec.

    def _let_go_of_input(self) -> None:
        """The program alone shall hold it: whoever writes there when it has closed it is to hear of that."""
        null = os.open("/dev/null", os.O_RDONLY | os.O_CLOEXEC)
        os.dup2(null, 0)
        os.close(null)

    def _become(self, failed: int) -> NoReturn:
        """Become the program. What is open besides the standard streams closes with the exec."""
        command, cwd = self._order["command"], self._order["cwd"]
        what = command[0]
        try:
            prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
            if os.getppid() != self._keeper:
                os._exit(1)  # The keeper died before the kernel knew what to do then.
            os.setsid()
            signal.set_wakeup_fd(-1)
            for number in _RESTORED:
                signal.signal(number, signal.SIG_DFL)
            signal.pthread_sigmask(signal.SIG_SETMASK, ())
            self._limit()
            if cwd is not None:
                what = cwd
                os.chdir(cwd)
                what = command[0]
            os.execvpe(command[0], command, self._order["env"])
        except BaseException as error:
            text = f"{error.strerror}: {what}" if isinstance(error, OSError) else f"{type(error).__name__}: {error}"
            os.write(failed, text.encode("utf-8", "replace")[:4000])
        os._exit(127)

    def _limit(self) -> None:
        limits = self._order["limits"]
        if limits:
            import resource

            for name, number in LIMITS.items():
                if limits.get(name):
                    resource.setrlimit(number, (limits[name], limits[name]))
            if limits.get("niceness"):
                os.nice(limits["niceness"])

    # -- deaths -----------------------------------------------------------------------------------------------------

    def _reap(self) -> None:
        """Take the wait status of all that have died, adopted ones among them."""
        try:
            os.read(self._wake_out, 4096)
        except BlockingIOError:
            pass
        try:
            while (found := os.waitpid(-1, os.WNOHANG))[0]:
                self._note(*found)
        except ChildProcessError:
            pass

    def _note(self, pid: int, status: int) -> None:
        if pid == self._pid:
            self._status = status

    def _end_all(self) -> None:
        """Kill and reap until nothing is left; the children of what is reaped come to us, which is another round."""
        is_told = False
        try:
            while True:
                why = kill_all(children())
                if why and not is_told:
                    is_told = True
                    if self._status is None:  # Those in its group who are no children of ours may be within reach.
                        kill_all([-self._pid])
                    self._tell(DENIED + why)
                self._note(*os.waitpid(-1, 0))
        except ChildProcessError:
            pass


def kill_all(pids: list[int]) -> bytes:
    """SIGKILL for each; returns why one cannot be killed, nothing if all can."""
    why = b""
    for pid in pids:
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            pass
        except OSError as error:
            why = f"process {pid}: {error.strerror}".encode()
    return why


def children() -> list[int]:
    """Our children, adopted ones included; none is reaped while we look, so each number is still its own."""
    me = os.getpid()
    try:
        with open(f"/proc/self/task/{me}/children", "rb") as file:
            return [int(pid) for pid in file.read().split()]
    except OSError:  # A kernel without CONFIG_PROC_CHILDREN.
        return [int(name) for name in os.listdir("/proc") if name.isdecimal() and parent_of(name) == me]


def parent_of(pid: str) -> int:
    """Parent's pid, or -1 when the process is gone."""
    try:
        with open(f"/proc/{pid}/stat", "rb") as file:
            return int(file.read().rpartition(b")")[2].split()[1])
    except (OSError, IndexError):
        return -1


def main() -> None:
    """Entry: `reaper.py CONTROL ORDER OWNER`: two descriptors and the owner's pid."""
    control, order_fd, owner = map(int, sys.argv[1:])
    os.set_inheritable(control, False)
    with open(order_fd, "rb") as file:
        order = marshal.load(file)
    Reaper(control, owner, order).run()


if __name__ == "__main__":
    main()
    os._exit(0)  # The work is done: nothing is to be cleaned up.
