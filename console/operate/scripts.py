"""The command that has a script change a running system: apply."""

from __future__ import annotations

import asyncio
import difflib
import os
import traceback
from pathlib import Path

import typer

from ...actors.errors import HoldfastError, SpecError
from ...system.script import load_script
from ...system.upgrade.new_program import find_in
from ..remote import RemoteChange, RemoteRef, RemoteSystem
from .reaching import FAILED, GREETING_SECONDS, UNUSABLE, chosen, ended, told

SENDS = ("ask", "tell", "send")
"""What a ref of the program itself has, and that of a script has not."""
NO_MESSAGES = (
    "a script sends no messages, so that its refs have no '{name}': it looks, controls and changes. What has to send "
    "some runs in the program: as the same file, by `await system.apply(...)`, or by an endpoint of your own"
)


def run_script(script: Path, system: str | None, socket: Path | None, *, dry_run: bool, timeout: float) -> None:
    """Run a reconfiguration script against a running system, and show what each of its transactions has done."""
    with told("apply"):
        find_in(os.getcwd(), first=False)  # What a script imports must hide nothing of others.
        try:
            loaded = load_script(script)
        except SpecError as error:
            raise ended("apply", error, UNUSABLE) from error
        source = (loaded.source.path, loaded.source.sha256)
        path = chosen(system, socket)
        with RemoteSystem(path, dry_run=dry_run, timeout=timeout, script=source, told=_show) as remote:
            remote.greet(GREETING_SECONDS)
            _run(loaded.reconfigure, remote, script)
    typer.echo("nothing was done: this was a dry run" if dry_run else "done")


def _run(reconfigure: object, system: RemoteSystem, script: Path) -> None:
    async def main() -> None:
        await reconfigure(system)  # type: ignore[operator]  # it was looked at when it was loaded

    try:
        asyncio.run(main())
    except HoldfastError:
        raise
    except AttributeError as error:
        if not isinstance(error.obj, (RemoteChange, RemoteRef, RemoteSystem)):
            raise _own(error) from error
        raise SpecError(_line(script, error), _missing(error.obj, error.name)) from error
    except Exception as error:
        raise _own(error) from error


def _own(error: Exception) -> typer.Exit:
    """What ends a script by an error of its own: its user wants to see where."""
    typer.echo("".join(traceback.format_exception(error)), err=True)
    return typer.Exit(FAILED)


def _line(script: Path, error: Exception) -> str:
    """The line of the script in which an error was raised."""
    lines = [one.lineno for one in traceback.extract_tb(error.__traceback__) if Path(one.filename).name == script.name]
    return f"{script}:{lines[-1]}" if lines else str(script)


def _missing(of: RemoteChange | RemoteRef | RemoteSystem, name: str | None) -> str:
    """What a script has called that there is not, and what there is."""
    if isinstance(of, RemoteRef) and name in SENDS:
        return NO_MESSAGES.format(name=name)
    what = {RemoteChange: "a transaction", RemoteRef: "an actor", RemoteSystem: "the system"}[type(of)]
    there = sorted(one for one in dir(of) if not one.startswith("_"))
    close = difflib.get_close_matches(name or "", there, 1)
    meant = f"; did you mean {close[0]}?" if close else "."
    listed = f"There are {', '.join(there)}" if len(there) > 1 else f"There is {there[0]}, and nothing else"
    return f"{what} has no {name!r} in a script{meant} {listed}"


def _show(change: RemoteChange) -> None:
    typer.echo(change.describe())
