"""What a program knows of the servers of its store."""

from __future__ import annotations

import dataclasses

from ..actors.events import ServersSilent, StandingBy


@dataclasses.dataclass(slots=True)
class ServersSeen:
    """What was told last of the servers of a store.

    Attributes:
        standing: that another program leads.
        silent: why they do not answer, while that is so.
    """

    standing: StandingBy | None = None
    silent: ServersSilent | None = None
