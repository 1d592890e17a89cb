"""Where running systems are found by name: a folder of this user with one socket for each."""

from __future__ import annotations

import dataclasses
import os
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote, unquote

from ..system.script import UntrustedFile, check_folders
from .claims import EndpointInUse, claimed, clear

ENDING = ".sock"


@dataclasses.dataclass(frozen=True, slots=True, order=True)
class FoundSocket:
    """A socket in the folder: its path, and what its name says of the system that has made it."""

    system: str
    pid: int
    path: Path


def runtime_folder() -> Path:
    """The folder for the sockets of this user's systems, made if it is not there; nobody else may look into it.

    It is `$XDG_RUNTIME_DIR/holdfast`, else `holdfast-UID` in the folder for temporary files.

    Raises:
        UntrustedFile: it belongs to somebody else, others may enter it, or it cannot be made.
    """
    given = os.environ.get("XDG_RUNTIME_DIR", "")
    own = os.geteuid()
    folder = Path(given, "holdfast") if given else Path(tempfile.gettempdir(), f"holdfast-{own}")
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        info = os.lstat(folder)
    except OSError as error:
        raise UntrustedFile(str(folder), f"{error.strerror or error}; set XDG_RUNTIME_DIR") from error
    if not stat.S_ISDIR(info.st_mode):
        raise UntrustedFile(str(folder), "it is no folder")
    if info.st_uid != own:
        raise UntrustedFile(str(folder), f"it belongs to the user with uid {info.st_uid}, not to you")
    if info.st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        mode = stat.S_IMODE(info.st_mode)
        raise UntrustedFile(str(folder), f"others may enter it (mode {mode:04o}); chmod 700")
    check_folders(folder, {own})
    return folder


def socket_path(system: str) -> Path:
    """Where a system of this process has its socket, if it says no other path. Raises UntrustedFile."""
    return runtime_folder() / f"{quote(system, safe='')}.{os.getpid()}{ENDING}"


def found_sockets() -> list[FoundSocket]:
    """All sockets in the folder, also those that dead processes have left. Raises UntrustedFile."""
    return sorted(_found(runtime_folder()))


def _found(folder: Path) -> Iterator[FoundSocket]:
    for path in folder.glob(f"*{ENDING}"):
        name, _, pid = path.name.removesuffix(ENDING).rpartition(".")
        if name and pid.isdecimal():
            yield FoundSocket(unquote(name), int(pid), path)


def sweep() -> None:
    """Remove what dead processes have left in the folder. Raises UntrustedFile."""
    folder = runtime_folder()
    left = {*folder.glob(f"*{ENDING}"), *(lock.with_suffix("") for lock in folder.glob(f"*{ENDING}.lock"))}
    for path in left:
        try:
            with claimed(path):  # Whoever lives, or is about to, has the claim.
                clear(path)
        except EndpointInUse:
            continue
