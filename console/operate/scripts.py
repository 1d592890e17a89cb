"""The command that has a script change a running system: apply."""

from __future__ import annotations

import asyncio
import traceback
from pathlib import Path

import typer

from ...actors.errors import HoldfastError, SpecError
from ...system.script import load_script
from ..remote import RemoteChange, RemoteSystem
from .reaching import FAILED, GREETING_SECONDS, UNUSABLE, chosen, ended, told


def run_script(script: Path, system: str | None, socket: Path | None, *, dry_run: bool, timeout: float) -> None:
    """Run a reconfiguration script against a running system, and show what each of its transactions has done."""
    with told("apply"):
        try:
            loaded = load_script(script)
        except SpecError as error:
            raise ended("apply", error, UNUSABLE) from error
        source = (loaded.source.path, loaded.source.sha256)
        path = chosen(system, socket)
        with RemoteSystem(path, dry_run=dry_run, timeout=timeout, script=source, told=_show) as remote:
            remote.greet(GREETING_SECONDS)
            _run(loaded.reconfigure, remote)
    typer.echo("nothing was done: this was a dry run" if dry_run else "done")


def _run(reconfigure: object, system: RemoteSystem) -> None:
    async def main() -> None:
        await reconfigure(system)  # type: ignore[operator]  # it was looked at when it was loaded

    try:
        asyncio.run(main())
    except HoldfastError:
        raise
    except Exception as error:  # The script's own: its user wants to see where.
        typer.echo(traceback.format_exc(), err=True)
        raise typer.Exit(FAILED) from error


def _show(change: RemoteChange) -> None:
    typer.echo(change.describe())
