"""Anonymous memory that two processes share, and that neither can take away from the other.

A mapping that reaches behind the end of its file kills whoever reads it (SIGBUS). So a file that is shared is sealed
before it is mapped: from then on nobody can make it shorter, not even a process that still holds it and means harm.
"""

from __future__ import annotations

import os
from typing import Final

F_SEAL_FUTURE_WRITE: Final = 0x10
"""As in Linux's fcntl.h; Python has no name for it."""


def unnamed(name: str) -> int:
    """A new file in memory, which goes with the last who holds it; `name` is shown in /proc."""
    return os.memfd_create(name, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)


def keep_size(file: int) -> None:
    """Let a file of `unnamed` stay as long as it is, for everybody who holds it.

    Raises:
        OSError: it is no such file.
    """
    import fcntl  # not everywhere; where it is not, there is no such memory either

    wanted = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW
    if fcntl.fcntl(file, fcntl.F_GET_SEALS) & wanted != wanted:
        fcntl.fcntl(file, fcntl.F_ADD_SEALS, wanted)


def keep_contents(file: int) -> None:
    """Let what is in a file of `unnamed` stay as it is, for everybody who opens it; private mappings are their own.

    Raises:
        OSError: it is no such file, or the system is too old (Linux 5.1 has it).
    """
    import fcntl

    keep_size(file)
    fcntl.fcntl(file, fcntl.F_ADD_SEALS, F_SEAL_FUTURE_WRITE)
