"""Resource limits of an actor's OS process."""

from __future__ import annotations

import dataclasses
from typing import Any

from ..errors import SpecError


@dataclasses.dataclass(frozen=True, slots=True)
class Limits:
    """Limits of one OS process; None leaves the system's own.

    Attributes:
        address_space_bytes: RLIMIT_AS; an allocation above it raises MemoryError in the actor.
        open_files: RLIMIT_NOFILE.
        niceness: added to the priority, 0 to 19.
        memory_bytes: resident memory at which the watch ends the process (OutOfMemory).
        cpu_share: cores used, averaged over `watch_interval`, at which the watch ends the process.
        watch_interval: seconds between two looks of the watch.
        hung_after: seconds without a beat of the process's loop after which it is ended (Hung); must exceed the
            longest honest turn that blocks.
    """

    address_space_bytes: int | None = None
    open_files: int | None = None
    niceness: int = 0
    memory_bytes: int | None = None
    cpu_share: float | None = None
    watch_interval: float = 1.0
    hung_after: float | None = None

    def __post_init__(self) -> None:
        for name in ("address_space_bytes", "open_files", "memory_bytes", "cpu_share", "hung_after"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise SpecError("Limits", f"{name} must be > 0, not {value!r}")
        if not 0 <= self.niceness <= 19:
            raise SpecError("Limits", f"niceness must be 0 to 19, not {self.niceness!r}")
        if not self.watch_interval > 0:
            raise SpecError("Limits", f"watch_interval must be > 0 seconds, not {self.watch_interval!r}")


def limits_data(limits: Limits | None) -> dict[str, Any]:
    """The limits of a process as plain data; `Limits(**data)` are the same again."""
    return {} if limits is None else dataclasses.asdict(limits)
