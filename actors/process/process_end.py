"""The end of an actor process: collects what is known of it, and derives the exit reason."""

from __future__ import annotations

import dataclasses
import os
import signal

from ..exit_reasons import Exited, ExitReason, OutOfMemory, Signal


@dataclasses.dataclass(slots=True)
class ProcessEnd:
    """What has been said and seen of the end of one process, by whoever was first."""

    oom_before: int
    """How often the kernel's out-of-memory killer had struck when the process began."""
    told: ExitReason | None = None
    """The reason that the actor itself gave."""
    killed_for: ExitReason | None = None
    """What we have killed it for; it may not have died yet."""
    status: int | None = None
    """How the fork server has reaped it, as `waitpid` reports it."""
    orphaned: ExitReason | None = None
    """What its fork server has ended it for, by its own end: nobody will tell its status."""
    is_lost: bool = False
    """Whether its socket has ended: what it wrote before its end has come."""
    is_buried: bool = False
    """Whether it was given up, and everybody told."""
    noticed_at: float = 0.0
    """When the first sign of its end came, on the monotonic clock."""

    @property
    def is_complete(self) -> bool:
        """Whether nothing more will be heard of it."""
        return self.is_lost and (self.status is not None or self.orphaned is not None)

    def reason(self, oom_kills: int) -> ExitReason:
        """Why it ended: what it said itself, what we killed it for, or what the system reports.

        >>> ProcessEnd(0, status=signal.SIGKILL).reason(0), ProcessEnd(0, status=3 << 8).reason(0)
        (Signal(number=9), Exited(code=3))
        """
        if self.told is not None:
            return self.told
        if self.killed_for is not None:
            return self.killed_for
        status = self.status
        if status is None:
            return self.orphaned or Signal(signal.SIGKILL)
        if os.WIFSIGNALED(status):
            number = os.WTERMSIG(status)
            if number == signal.SIGKILL and oom_kills > self.oom_before:
                return OutOfMemory("killed by the kernel")
            return Signal(number)
        return Exited(os.waitstatus_to_exitcode(status))
