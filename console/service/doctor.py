"""`holdfast doctor`: what of the machine is as a system needs it, and what to do about the rest."""

from __future__ import annotations

import ctypes
import dataclasses
import importlib.metadata
import importlib.util
import os
import platform
import resource
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Final, Literal

import psutil
import typer

from ...actors.errors import HoldfastError
from ..operate.reaching import FAILED, Json, show_json
from ..runtime_folder import found_sockets, runtime_folder
from .store_options import KeyFile

Verdict = Literal["ok", "warning", "failed"]
LEAST_FILES: Final = 4096
"""Descriptors: some for each process actor, and one for each connection."""
LEAST_ROOM: Final = 1_000_000_000
"""Bytes that should be free beside a store."""
NO_ROOM: Final = 1_000_000
"""Bytes beside a store below which it takes nothing, or soon will not."""
NETWORK: Final = {"nfs", "nfs4", "cifs", "smb3", "fuse.sshfs", "9p", "ceph", "glusterfs"}
"""File systems over a network, whose locks and fsync are not those that a store relies on."""
UNSYNCHRONISED: Final = 5
"""What adjtimex returns if nobody keeps the clock right."""


@dataclasses.dataclass(frozen=True, slots=True)
class MachineFinding:
    """One thing that was looked at."""

    about: str
    verdict: Verdict
    found: str
    advice: str = ""


def ok(about: str, found: str) -> MachineFinding:
    """All is as it should be."""
    return MachineFinding(about, "ok", found)


def warn(about: str, found: str, advice: str) -> MachineFinding:
    """It works, but not under all circumstances."""
    return MachineFinding(about, "warning", found, advice)


def fail(about: str, found: str, advice: str) -> MachineFinding:
    """It does not work so."""
    return MachineFinding(about, "failed", found, advice)


def python() -> Iterator[MachineFinding]:
    """The interpreter, the event loop, and the operating system."""
    yield ok("python", f"{platform.python_version()} at {sys.executable}")
    if importlib.util.find_spec("uvloop") is not None:
        yield ok("uvloop", importlib.metadata.version("uvloop"))
    else:
        yield warn("uvloop", "not installed", "pip install uvloop: messages are handled faster")
    if sys.platform == "linux":
        yield ok("system", f"{platform.system()} {platform.release()}")
    else:
        yield warn("system", sys.platform, "actors in processes need Linux; elsewhere there are tasks only")


def limits() -> Iterator[MachineFinding]:
    """What the kernel lets this user have."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or soft >= LEAST_FILES:
        yield ok("open files", str(soft))
    else:
        yield warn("open files", f"{soft} (hard limit {hard})", f"ulimit -n {LEAST_FILES}, or LimitNOFILE= of the unit")
    most, _ = resource.getrlimit(resource.RLIMIT_NPROC)
    if most in (-1, resource.RLIM_INFINITY) or most >= 1024:
        yield ok("processes", "no limit" if most in (-1, resource.RLIM_INFINITY) else str(most))
    else:
        yield warn("processes", str(most), "ulimit -u 4096: each process actor is a process, each replica too")


def memory() -> Iterator[MachineFinding]:
    """Shared memory, the memory of the machine, and the limits of a container."""
    if sys.platform == "linux":
        try:
            os.close(os.memfd_create("holdfast-doctor"))
            yield ok("shared memory", "memfd works; the size of /dev/shm does not matter")
        except OSError as error:
            yield fail("shared memory", f"memfd_create: {error.strerror}", "allow memfd_create in the seccomp profile")
    total = psutil.virtual_memory().total
    allowed = cgroup_number("memory.max")
    if allowed is None or allowed >= total:
        yield ok("memory", f"{total / 1e9:.1f} GB, no limit of a cgroup")
    else:
        advice = "give process actors Limits(memory_bytes=...) whose sum is below it: else the kernel picks who ends"
        yield warn("memory", f"a cgroup allows {allowed / 1e9:.1f} GB of {total / 1e9:.1f} GB", advice)
    yield ok("processors", f"{len(os.sched_getaffinity(0)) if sys.platform == 'linux' else os.cpu_count()}")


def cgroup_number(name: str) -> int | None:
    """A limit of the cgroup (version 2) in which this process is; None: there is none."""
    try:
        group = Path("/proc/self/cgroup").read_text().strip().rpartition("::")[2]
        text = Path("/sys/fs/cgroup", group.lstrip("/"), name).read_text().strip()
    except OSError:
        return None
    return int(text) if text.isdecimal() else None


def clock() -> Iterator[MachineFinding]:
    """Whether the clock of the machine is kept right: timers that wait for days go by it."""
    state = clock_state()
    if state is None:
        yield warn("clock", "it cannot be asked", "see to it that the clock is synchronised (NTP)")
    elif state == UNSYNCHRONISED:
        yield warn("clock", "nobody synchronises it", "run chrony or systemd-timesyncd: long waits go by the clock")
    else:
        yield ok("clock", "synchronised")


def clock_state() -> int | None:
    """What adjtimex returns, which changes nothing here; None where it cannot be asked."""
    try:
        asked = ctypes.CDLL(None).adjtimex
    except (OSError, AttributeError):
        return None
    state = int(asked(ctypes.create_string_buffer(512)))
    return None if state < 0 else state


def folder() -> Iterator[MachineFinding]:
    """Where systems are found by name."""
    try:
        where = runtime_folder()
        systems = ", ".join(f"{one.system} (pid {one.pid})" for one in found_sockets()) or "no system"
        yield ok("runtime folder", f"{where}: {systems}")
    except HoldfastError as error:
        yield fail("runtime folder", str(error), "systems are not found by name; set XDG_RUNTIME_DIR, or use --socket")


def store(path: Path, key_file: Path | None = None) -> Iterator[MachineFinding]:
    """A store: where it is, what room it has, and whether all of it is good."""
    about = f"store {path}"
    if not path.exists():
        yield fail(about, "it is not there", "name the database: app.db, as in store='sqlite:app.db'")
        return
    kind = file_system(path)
    if kind in NETWORK:
        yield fail(about, f"on {kind}", "put it on a local disk: locks and fsync of a network are not to be relied on")
    free = shutil.disk_usage(path.parent).free
    if free < NO_ROOM:
        yield fail(about, f"{free / 1e9:.2f} GB free", "make room: nothing is accepted any more")
    elif free < LEAST_ROOM:
        yield warn(about, f"{free / 1e9:.2f} GB free", "make room: when there is none nothing is accepted any more")
    if not os.access(path, os.R_OK | os.W_OK) or not os.access(path.parent, os.W_OK):
        yield fail(about, "this user may not write it, or its folder", "chown it to the user of the program")
        return
    from ...checkpoint.store_tools import verify_store  # only now: sqlite3 takes a while to import

    try:
        found = verify_store(path, key=key_file)
    except HoldfastError as error:
        yield fail(about, str(error), "holdfast store verify says more")
        return
    if found.is_good:
        yield ok(about, f"good, {free / 1e9:.1f} GB free")
    else:
        yield fail(about, f"{len(found.damages)} places are damaged", "holdfast store verify says where")


def file_system(path: Path) -> str:
    """The kind of the file system on which a file is; empty if that is not known."""
    full = str(path.resolve())
    mounts = [one for one in psutil.disk_partitions(all=True) if full.startswith(one.mountpoint.rstrip("/") + "/")]
    return max(mounts, key=lambda one: len(one.mountpoint)).fstype if mounts else ""


LOOKS: Final[tuple[Callable[[], Iterator[MachineFinding]], ...]] = (python, limits, memory, clock, folder)
COLOURS: Final = {"ok": "green", "warning": "yellow", "failed": "red"}


def doctor(
    stores: Annotated[
        list[Path] | None, typer.Argument(metavar="[STORE]...", help="Databases of stores to look at, too.")
    ] = None,
    key_file: KeyFile = None,
    as_json: Json = False,
) -> None:
    """Look at the machine: Python, limits, memory, clock, the runtime folder, and the stores that are named.

    Exit status 0: nothing has failed; there may be warnings. 1: something has.
    """
    found = [one for look in LOOKS for one in look()]
    found += [one for path in stores or () for one in store(path, key_file)]
    if as_json:
        show_json([dataclasses.asdict(one) for one in found])
    else:
        for one in found:
            verdict = typer.style(one.verdict.ljust(7), fg=COLOURS[one.verdict])
            typer.echo(f"{verdict}  {one.about}: {one.found}")
            if one.advice:
                typer.echo(f"         {one.advice}")
    if any(one.verdict == "failed" for one in found):
        raise typer.Exit(FAILED)
