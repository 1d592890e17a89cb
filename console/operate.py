"""The commands that reach a running system: apply, tree, status."""

from __future__ import annotations

import asyncio
import dataclasses
import time
import traceback
from pathlib import Path
from typing import Annotated

import typer

from ..actors.errors import HoldfastError, SpecError
from ..ftm.group.protected import ProtectionStatus
from ..system.script import UntrustedFile, load_script
from .remote import NotReached, RemoteChange, RemoteSystem
from .wire import WrongUser

FAILED = 1
UNUSABLE = 2

Socket = Annotated[Path, typer.Option("--socket", help="The control endpoint of the running system.")]


def apply(
    script: Annotated[Path, typer.Argument(help="A file with `async def reconfigure(system)`.")],
    socket: Socket,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would be done.")] = False,
    timeout: Annotated[float, typer.Option(min=0.1, max=3600.0, help="Seconds a transaction may take.")] = 10.0,
) -> None:
    """Run a reconfiguration script against a running system.

    Exit status 0: done. 1: refused, or failed and undone. 2: the script or the system cannot be had.
    """
    try:
        loaded = load_script(script)
        source = loaded.source
        system = RemoteSystem(socket, dry_run=dry_run, timeout=timeout, script=(source.path, source.sha256), told=_show)
    except (UntrustedFile, NotReached, WrongUser, SpecError) as error:
        raise _failed("apply", error, UNUSABLE) from error
    try:
        with system:
            _run(loaded.reconfigure, system)
    except NotReached as error:
        raise _failed("apply", error, UNUSABLE) from error
    except HoldfastError as error:
        raise _failed("apply", error, FAILED) from error
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


def tree(socket: Socket) -> None:
    """Print the addresses that live in a running system."""
    try:
        with RemoteSystem(socket) as system:
            for path in system.tree():
                typer.echo(path)
    except (NotReached, WrongUser) as error:
        raise _failed("tree", error, UNUSABLE) from error
    except HoldfastError as error:
        raise _failed("tree", error, FAILED) from error


def status(
    path: Annotated[str, typer.Argument(help="An address, such as /app/bank/alice.")],
    socket: Socket,
) -> None:
    """Print how an actor of a running system is."""
    try:
        with RemoteSystem(socket) as system:
            found = asyncio.run(system.get_status(path))
            protection = asyncio.run(system.protection(path))
    except (NotReached, WrongUser) as error:
        raise _failed("status", error, UNUSABLE) from error
    except HoldfastError as error:
        raise _failed("status", error, FAILED) from error
    for name, value in dataclasses.asdict(found).items():
        typer.echo(f"{name}: {'-' if value is None else value}")
    typer.echo(f"protection: {protection_text(protection)}")


def protection_text(found: ProtectionStatus) -> str:
    """How an actor is protected, in a line."""
    if not found.is_protected:
        return "none"
    replicas = ", ".join(f"{name} {state}" for name, state in found.replicas.items())
    since = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(found.since))
    whole = "whole" if found.is_whole else "not whole"
    more = (", changing" if found.is_changing else "") + (", on probation" if found.is_on_probation else "")
    return f"{' + '.join(found.stack)}, {whole} since {since}, epoch {found.epoch} ({replicas or 'starting'}){more}"


def _failed(command: str, error: Exception, code: int) -> typer.Exit:
    typer.echo(f"holdfast {command}: {error}", err=True)
    return typer.Exit(code)
