"""The children of this process, adopted ones included: finding them, and signalling them."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Collection, Iterator


def send_signal(pid: int, signum: int) -> None:
    """Signal a child of ours. Not reaped yet, so its pid is still its own; it may be a zombie, which is no error."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signum)


def signal_by(pidfd: int, signum: int) -> bool:
    """Signal the very process that a pidfd means; it may be dead. Returns whether that could be done.

    A system can refuse it (a security module, another user's process): nobody ends for that.
    """
    try:
        signal.pidfd_send_signal(pidfd, signum)
    except ProcessLookupError:
        return True
    except OSError:
        return False
    return True


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
