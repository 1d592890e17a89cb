"""Anonymous memory that two processes share, and that neither can take away from the other.

A mapping that reaches behind the end of its file kills whoever reads it (SIGBUS). So a file that is shared is sealed
before it is mapped: from then on nobody can make it shorter, not even a process that still holds it and means harm.
"""

from __future__ import annotations

import os


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
