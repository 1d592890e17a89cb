"""Memory and processor time of a system's processes, read from the operating system; call it in a thread."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import psutil

from .series import Labels

RESERVE, HELPERS = "reserve", "helpers"
"""Processes that wait for an actor; and the fork server, those of effects and programs, and what else was begun."""


@dataclasses.dataclass(slots=True)
class Usage:
    """What the processes of one label use."""

    resident_bytes: int = 0
    cpu_seconds: float = 0.0


def usage_of(root: str, pids: Mapping[int, str], labels: Labels) -> tuple[dict[str, Usage], int]:
    """What this process and those that it has begun use, and how many they are.

    Args:
        root: the label of this process.
        pids: the processes of actors, with their addresses.
        labels: of addresses.
    """
    this = psutil.Process()
    found: dict[str, Usage] = {}
    count = 0
    for process in (this, *this.children(recursive=True)):
        if process.pid == this.pid:
            label = root
        else:
            address = pids.get(process.pid)
            label = HELPERS if address is None else labels.of(address) if address else RESERVE
        try:
            with process.oneshot():
                times = process.cpu_times()
                resident = process.memory_info().rss
        except psutil.Error:  # It has ended meanwhile.
            continue
        count += 1
        used = found.setdefault(label, Usage())
        used.resident_bytes += resident
        used.cpu_seconds += times.user + times.system
    return found, count
