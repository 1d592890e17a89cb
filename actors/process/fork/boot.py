"""The first steps of the fork server: make holdfast importable as the parent has it, then hand over to `zygote.py`.

It is run as a file by `ForkServer` (`fork_server.py`) and imports the standard library only, so that it can put the
parent's `sys.path` in place before anything of holdfast or of the user is imported. What parent and server say to each
other is here too, for both import it from here.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import importlib.util
import json
import os
import signal
import socket
import struct
import sys
from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple

HEADER = struct.Struct("<BIi")  # kind, number, value; a text may follow
PACKET_BYTES = 64 * 1024  # a packet is header and text; longer texts are cut
PAGE_BYTES = 64 * 1024  # only what is touched takes memory
SERVER_VARIABLE = "HOLDFAST_FORK_SERVER"  # pid of the fork server, set in it and seen by all its descendants
OWNER_VARIABLE = "HOLDFAST_PROCESS"  # number of the actor process, set in it and seen by the programs it starts

PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36


class PacketKind(IntEnum):
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
    server: str  # the module that takes over once it can be imported
    package: str
    package_path: list[str]
    main: str  # module name or path of the program, "" for none
    main_is_path: bool


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


def watch_parent(parent: int) -> int:
    """Be killed when the parent ends; a pidfd of it, or -1 if it has ended already."""
    # While modules are imported nobody looks at the socket; there are no children yet, so being killed is fine.
    bind_prctl()(PR_SET_PDEATHSIG, signal.SIGKILL)
    # The end of the socket is not enough: a process the parent forked without exec holds a copy of the other end.
    try:
        parent_fd = os.pidfd_open(parent)
    except ProcessLookupError:
        return -1
    return parent_fd if os.getppid() == parent else -1


def hand_over(control: socket.socket, config: Config) -> None:
    """Import what serves, and serve; returns when the parent is gone or hangs up."""
    parent_fd = watch_parent(config.parent)
    if parent_fd < 0:
        return
    os.environ[SERVER_VARIABLE] = str(os.getpid())
    sys.path[:], sys.argv[:] = config.path, config.argv
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell that started us with & has it ignored
    gc.disable()  # Until our own modules are there: collections find nothing, and take a tenth of the time.
    try:
        adopt_package(config.package, config.package_path)
        zygote: Any = importlib.import_module(config.server)
    except BaseException as error:
        why = f"{type(error).__name__}: {error}".encode(errors="replace")
        with contextlib.suppress(ConnectionError):  # nobody is left to be told
            control.send(HEADER.pack(PacketKind.BROKEN, 0, 0) + why)
        return
    zygote.Zygote(control, config, parent_fd).run()


def main() -> None:
    """Entry of the exec'd process: `boot.py <descriptor of the control socket>`."""
    signal.pthread_sigmask(signal.SIG_SETMASK, ())  # the parent's mask outlives exec; without SIGCHLD we reap nothing
    control = socket.socket(fileno=int(sys.argv[1]))
    control.set_inheritable(False)
    with control:
        packet = control.recv(1 << 20)
        if packet:  # otherwise the parent ended at once
            hand_over(control, Config(**json.loads(packet[HEADER.size :])))


if __name__ == "__main__":
    main()
    # Threads and exit handlers of preloaded modules are no reason to stay, or to do anything: the work is done.
    os._exit(0)
