"""Starts the fork server: its command, its environment, and what it is told about this process."""

from __future__ import annotations

import builtins
import ctypes
import importlib
import os
import subprocess
import sys
import sysconfig

from ...errors import ProcessUnavailable, SpecError
from . import boot
from .boot import OWNER_VARIABLE, SERVER_VARIABLE, Config

# Without these, messages of a megabyte cost a page fault per page each time: 4 to 5 times slower.
_MALLOC = {
    "MALLOC_MMAP_THRESHOLD_": "67108864",
    "MALLOC_TRIM_THRESHOLD_": "134217728",
    "MALLOC_TOP_PAD_": "16777216",
}
M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD = -1, -2, -3  # as in malloc.h
# Native thread pools: their threads would not survive the fork, and bit-identical replay needs one thread.
_THREADS = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}

ADDED_VARIABLE = "HOLDFAST_ADDED"  # names of the variables above that the fork server was given


def server_environment() -> dict[str, str]:
    """Our environment; what the user has set stays as it is."""
    added = {name: value for name, value in {**_MALLOC, **_THREADS}.items() if name not in os.environ}
    return {**added, **os.environ, ADDED_VARIABLE: " ".join(added)}


def outside_environment() -> dict[str, str]:
    """The environment as it is outside of holdfast's processes: for programs that have nothing to do with it."""
    ours = {OWNER_VARIABLE, ADDED_VARIABLE, *os.environ.get(ADDED_VARIABLE, "").split()}
    return {name: value for name, value in os.environ.items() if name not in ours}


def keep_large_memory() -> None:
    """Have malloc keep the memory of large messages instead of handing it back and faulting it in again each time.

    The same settings as actor processes get through their environment; whoever set those variables has chosen already.
    A message of 1 MiB otherwise costs four times as much.
    """
    if any(name.startswith("MALLOC_") for name in os.environ):
        return
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return  # Not glibc.
    for parameter, value in ((M_MMAP_THRESHOLD, 64 << 20), (M_TRIM_THRESHOLD, 128 << 20), (M_TOP_PAD, 16 << 20)):
        mallopt(parameter, value)


def check_can_start() -> None:
    """Raise ProcessUnavailable or SpecError where no fork server can or must be started."""
    check_is_program("fork server")  # Each would start the next one.
    if not sys.platform.startswith("linux"):
        raise ProcessUnavailable(f"actors in processes of their own need Linux (pidfd, memfd); this is {sys.platform}")


def check_is_program(where: str) -> None:
    """Raise SpecError in the fork server, which imports the program for its classes: nothing must run a second time."""
    if os.environ.get(SERVER_VARIABLE) == str(os.getpid()):
        problem = (
            "this program is being imported for the classes of its actors, by the process that processes are forked "
            'from, and must not run a second time; put what it does under `if __name__ == "__main__":`'
        )
        raise SpecError(where, problem)


def server_command(control_fd: int) -> list[str]:
    """The command that becomes the fork server."""
    # Our own flags (-O changes what `assert` means), and -P: the file's directory is no place to import from.
    flags: list[str] = subprocess._args_from_interpreter_flags()  # type: ignore[attr-defined]
    return [sys.executable, *flags, "-P", os.path.abspath(boot.__file__), str(control_fd)]


def exec_server(control_fd: int) -> subprocess.Popen[bytes]:
    """Start it: a child in a session of its own, with the given descriptor and our standard output and error.

    Raises:
        OSError: no process, memory or descriptor is left.
    """
    return subprocess.Popen(
        server_command(control_fd),
        stdin=subprocess.DEVNULL,
        stdout=inherited(1),
        stderr=inherited(2),
        pass_fds=(control_fd,),
        env=server_environment(),
        start_new_session=True,  # a Ctrl-C in the terminal is the program's business
    )


def inherited(fd: int) -> int | None:
    """Share a standard stream with the server, or give it /dev/null if a daemon has closed it."""
    try:
        os.fstat(fd)
    except OSError:
        return subprocess.DEVNULL
    return None


def server_config(entry: str, preload: list[str]) -> Config:
    """What the server must know of this process."""
    package = __name__.partition(".")[0]
    main, is_path = _program()
    return Config(
        parent=os.getpid(),
        entry=entry,
        preload=preload,
        path=import_path(),
        argv=sys.argv,
        server=f"{__package__}.zygote",
        package=package,
        package_path=[os.path.abspath(path) for path in importlib.import_module(package).__path__],
        main=main,
        main_is_path=is_path,
    )


def import_path() -> list[str]:
    """Where this process finds modules, as another one can be told: plain strings, without what imports overlook."""
    return [str(entry) or os.getcwd() for entry in sys.path if isinstance(entry, str)]


def _program() -> tuple[str, bool]:
    """What `__main__` is: a module's name, or a path (then True), or "" if it cannot be imported a second time."""
    module = sys.modules["__main__"]
    if why_not_importable():
        return "", False
    if module.__spec__ is not None:
        return module.__spec__.name, False
    assert module.__file__ is not None
    return os.path.abspath(module.__file__), True


def why_not_importable() -> str:
    """Why other processes cannot import `__main__`, and what to do about it; nothing if they can."""
    module = sys.modules["__main__"]
    if hasattr(sys, "ps1") or hasattr(builtins, "__IPYTHON__"):
        return "it is a notebook or a prompt; write the class into a .py file, and import it from there"
    if module.__spec__ is not None:  # python -m name; a package's __main__.py seldom has a guard
        name = module.__spec__.name
        if name == "__main__":
            return "it is the __main__.py of an archive or a folder; move the class to another module in there"
        package, _, last = name.rpartition(".")
        if last == "__main__":
            return f"it is the __main__.py of the package {package}; move the class to another module of the package"
        return ""
    file = getattr(module, "__file__", None)
    if file is None or not os.path.isfile(file):
        return "it was given with `python -c`, or through a pipe; write it into a .py file"
    if os.path.dirname(os.path.abspath(file)) in {os.path.dirname(sys.executable), sysconfig.get_path("scripts")}:
        return "it is a console script, such as pytest; move the class to a module"
    return ""
