"""The commands that bring a running system to what a file says: plan, apply."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Annotated

import typer

from ...actors.errors import SpecError
from ...system.script import read_source
from ..remote import RemoteChange, RemoteSystem
from .changing import show_change
from .losses import lost_by
from .reaching import UNUSABLE, DryRun, Json, Socket, System, Timeout, Yes, confirm, ended, reached, told
from .scripts import run_script


def plan(
    tree: Annotated[Path, typer.Argument(metavar="TREE.toml", help="The tree that is wanted.")],
    system: System = None,
    socket: Socket = None,
    as_json: Json = False,
) -> None:
    """Show the smallest change from what runs to what a file wants. Nothing is changed.

    Exit status 0: it can be done, or nothing is to be done. 1: it cannot be done. 2: no file, or no system.
    """
    if tree.suffix == ".py":
        raise ended(
            "plan", f"{tree}: a script is for `holdfast apply --dry-run`; a plan is made of a tree (.toml)", UNUSABLE
        )
    text = _read("plan", tree)
    with reached("plan", system, socket) as remote:
        change = asyncio.run(remote.declare(text, str(tree), dry_run=True))
        lost = _lost(change, remote)
    show_change(change, dry_run=True, as_json=as_json, lost=lost)


def apply(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="A tree (.toml), or a script with `async def reconfigure(system)`.")
    ],
    system: System = None,
    socket: Socket = None,
    dry_run: DryRun = False,
    yes: Yes = False,
    timeout: Timeout = 60.0,
    as_json: Json = False,
) -> None:
    """Bring a running system to what a file wants, as one transaction; or run a reconfiguration script.

    What stays keeps its state. If something would be lost you are asked.

    Exit status 0: done. 1: refused, or failed and undone. 2: the file or the system cannot be had.
    """
    if file.suffix != ".toml":
        run_script(file, system, socket, dry_run=dry_run, timeout=timeout)
        return
    text = _read("apply", file)
    with reached("apply", system, socket) as remote:
        change = asyncio.run(remote.declare(text, str(file), dry_run=True, timeout=timeout))
        lost = _lost(change, remote)
        if not dry_run and change.steps:
            confirm("apply", lost, yes=yes)
            change = asyncio.run(remote.declare(text, str(file), timeout=timeout))
    show_change(change, dry_run=dry_run, as_json=as_json, lost=lost)


def _read(command: str, file: Path) -> str:
    """What is in the file, which only this user could have written."""
    with told(command):
        try:
            return read_source(file).data.decode()
        except (SpecError, UnicodeDecodeError) as error:
            raise ended(
                command, f"{file}: {error}" if isinstance(error, UnicodeDecodeError) else error, UNUSABLE
            ) from error


def _lost(change: RemoteChange, remote: RemoteSystem) -> list[str]:
    """What is lost by a change, in sentences."""
    paths = {step.target for step in change.steps if step.verb in ("remove", "stop")}
    rows = remote.look().rows
    return [*change.lost, *lost_by([row for row in rows if row.path in paths], rows)]
