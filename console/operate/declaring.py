"""The commands that bring a running system to what a file says: apply."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .reaching import DryRun, Socket, System, Timeout
from .scripts import run_script


def apply(
    script: Annotated[Path, typer.Argument(help="A file with `async def reconfigure(system)`.")],
    system: System = None,
    socket: Socket = None,
    dry_run: DryRun = False,
    timeout: Timeout = 10.0,
) -> None:
    """Run a reconfiguration script against a running system.

    Exit status 0: done. 1: refused, or failed and undone. 2: the script or the system cannot be had.
    """
    run_script(script, system, socket, dry_run=dry_run, timeout=timeout)
