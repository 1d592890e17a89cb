"""The commands that change a running system: each is one transaction, or one call that there is."""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from ...actors.errors import ActorStopped, HoldfastError, NoSuchActor
from ...checkpoint.method import WITH_SNAPSHOTS
from ..overview import ActorRow
from ..remote import RemoteChange, RemoteSystem
from .losses import WARNINGS, held_up_by, lost_states, tops
from .patterns import read_pattern, select
from .reaching import (
    FAILED,
    DryRun,
    Json,
    OnePath,
    Paths,
    Patterned,
    Socket,
    System,
    Timeout,
    Yes,
    confirm,
    ended,
    meant_rows,
    reached,
    show_json,
)


def suspend(
    paths: Paths,
    system: System = None,
    socket: Socket = None,
    yes: Yes = False,
    dry_run: DryRun = False,
    timeout: Timeout = 10.0,
    as_json: Json = False,
) -> None:
    """Have actors handle no message until they are resumed; messages wait. All of them, or none: one transaction.

    The root, and a supervisor of many, is asked about: while it is suspended, none of its children is restarted.

    Exit status 0: done. 1: refused, nothing was done. 2: no system answers.
    """
    with reached("suspend", system, socket) as remote:
        all_rows = remote.look().rows
        rows = select(all_rows, paths)
        confirm("suspend", [] if dry_run else held_up_by(rows, all_rows), yes=yes)
        _transact(remote, lambda change: _each(change.suspend, rows), dry_run, timeout, as_json)


def resume(
    paths: Paths,
    system: System = None,
    socket: Socket = None,
    dry_run: DryRun = False,
    timeout: Timeout = 10.0,
    as_json: Json = False,
) -> None:
    """Have suspended actors handle messages again. All of them, or none: one transaction.

    Exit status 0: done. 1: refused, nothing was done. 2: no system answers.
    """
    with reached("resume", system, socket) as remote:
        rows = meant_rows(remote, paths)
        _transact(remote, lambda change: _each(change.resume, rows), dry_run, timeout, as_json)


def restart(
    paths: Paths,
    system: System = None,
    socket: Socket = None,
    yes: Yes = False,
    at_once: Annotated[
        bool, typer.Option("--kill", help="Kill them, in the middle of a turn that hangs; no hook is called.")
    ] = False,
    timeout: Timeout = 10.0,
    as_json: Json = False,
) -> None:
    """End the lives of actors in good order, one after another; their supervisors begin the next ones.

    Messages wait for the next life; with --kill whoever asked for the turn in hand hears that it was killed. The state
    of an actor without recovery is lost, and asked about. A restart counts for the supervisor as any other does: one
    that would make it give up is refused.

    Exit status 0: all of them are up again; with --kill, have ended. 1: one is not, and those behind it were left
    alone. 2: no system answers.
    """
    with reached("restart", system, socket) as remote:
        all_rows = remote.look().rows
        rows = select(all_rows, paths)
        confirm("restart", lost_states(rows, all_rows), yes=yes)
        done = [
            asyncio.run(remote.restart(row.path, timeout=timeout, at_once=at_once)) for row in _announced(rows, as_json)
        ]
    if as_json:
        show_json({"restarted": done})


def _announced(rows: list[ActorRow], as_json: bool) -> Any:
    """The rows, each named when it is done."""
    for row in rows:
        yield row
        if not as_json:
            typer.echo(f"restarted {row.path}")


def stop(
    paths: Paths,
    system: System = None,
    socket: Socket = None,
    yes: Yes = False,
    dry_run: DryRun = False,
    timeout: Timeout = 10.0,
    as_json: Json = False,
) -> None:
    """Stop children and keep their specs: `start` brings them back. All of them, or none: one transaction.

    Waiting messages are handed back to whoever sent them; what was recorded stays.

    Exit status 0: done. 1: refused, nothing was done. 2: no system answers.
    """
    _end("stop", paths, system, socket, yes, dry_run, timeout, as_json)


def remove(
    paths: Paths,
    system: System = None,
    socket: Socket = None,
    yes: Yes = False,
    dry_run: DryRun = False,
    timeout: Timeout = 10.0,
    as_json: Json = False,
) -> None:
    """Stop actors for good, also those of dynamic supervisors: their specs go. One transaction.

    Exit status 0: done. 1: refused, nothing was done. 2: no system answers.
    """
    _end("remove", paths, system, socket, yes, dry_run, timeout, as_json)


def _end(
    verb: str,
    paths: list[str],
    system: str | None,
    socket: Path | None,
    yes: bool,
    dry_run: bool,
    timeout: float,
    as_json: bool,
) -> None:
    with reached(verb, system, socket) as remote:
        all_rows = remote.look().rows
        rows = tops(select(all_rows, paths))
        confirm(verb, [] if dry_run else WARNINGS[verb](rows, all_rows), yes=yes)
        _transact(
            remote,
            lambda change: _each(change.stop if verb == "stop" else change.remove, rows),
            dry_run,
            timeout,
            as_json,
        )


def start(
    paths: Paths,
    system: System = None,
    socket: Socket = None,
    dry_run: DryRun = False,
    timeout: Timeout = 60.0,
    as_json: Json = False,
) -> None:
    """Start children again that were stopped. All of them, or none: one transaction.

    Exit status 0: they are up. 1: refused, nothing was done. 2: no system answers.
    """
    with reached("start", system, socket) as remote:
        rows = meant_rows(remote, paths)

        def collect(change: RemoteChange) -> None:
            for row in rows:
                above, _, name = row.path.rpartition("/")
                change.start(above, name)

        _transact(remote, collect, dry_run, timeout, as_json)


def bind(
    owner: OnePath,
    port: Annotated[str, typer.Argument(metavar="PORT", help="The name of the binding in the owner's class.")],
    target: OnePath,
    system: System = None,
    socket: Socket = None,
    dry_run: DryRun = False,
    timeout: Timeout = 10.0,
    as_json: Json = False,
) -> None:
    """Have a binding of an actor lead to another actor, from its next turn on and after restarts.

    Exit status 0: done. 1: refused, nothing was done. 2: no system answers.
    """
    with reached("bind", system, socket) as remote:
        (one,), (other,) = (meant_rows(remote, [path]) for path in (owner, target))
        _transact(remote, lambda change: change.bind(one.path, port, other.path), dry_run, timeout, as_json)


def unbind(
    owner: OnePath,
    port: Annotated[str, typer.Argument(metavar="PORT", help="The name of the binding in the owner's class.")],
    system: System = None,
    socket: Socket = None,
    dry_run: DryRun = False,
    timeout: Timeout = 10.0,
    as_json: Json = False,
) -> None:
    """Have a binding of an actor lead to nobody.

    Exit status 0: done. 1: refused, nothing was done. 2: no system answers.
    """
    with reached("unbind", system, socket) as remote:
        (one,) = meant_rows(remote, [owner])
        _transact(remote, lambda change: change.unbind(one.path, port), dry_run, timeout, as_json)


def protect(
    path: Patterned,
    mechanisms: Annotated[
        list[str] | None,
        typer.Argument(metavar="[MECHANISM]...", help="Outermost first: pbr, lfr, tr, or a file that defines one."),
    ] = None,
    off: Annotated[bool, typer.Option("--off", help="Have them protected by nothing.")] = False,
    system: System = None,
    socket: Socket = None,
    dry_run: DryRun = False,
    timeout: Timeout = 60.0,
    as_json: Json = False,
) -> None:
    """Have actors protected by just these mechanisms, whatever they have now; their lives go on. One transaction.

    New mechanisms are on probation for some seconds: `holdfast inspect` tells when they are settled.

    Exit status 0: done. 1: refused, nothing was done. 2: no system answers, or neither mechanisms nor --off are given.
    """
    if bool(mechanisms) == off:
        raise typer.BadParameter(f"give mechanisms, such as pbr, or --off{', not both' if off else ''}")
    with reached("protect", system, socket) as remote:
        rows = meant_rows(remote, [path])
        stack = tuple(mechanisms) if mechanisms else None
        _transact(remote, lambda change: _each(lambda one: change.protect(one, stack), rows), dry_run, timeout, as_json)


def checkpoint(
    paths: Paths, system: System = None, socket: Socket = None, timeout: Timeout = 10.0, as_json: Json = False
) -> None:
    """Have the states of recorded actors saved, and wait until they are; of a pattern, of those that have snapshots.

    Exit status 0: done. 1: one that is named has no snapshots, or one could not be saved in time. 2: no system answers.
    """
    with reached("checkpoint", system, socket) as remote:
        rows = meant_rows(remote, paths)
        names = [pattern for pattern in map(read_pattern, paths) if pattern.one is not None]
        named = {row.path for row in rows if any(pattern.matches(row) for pattern in names)}
        rows = [row for row in rows if row.path in named or row.recovery in WITH_SNAPSHOTS]
        failed: list[str] = []
        saved = 0
        for row in rows:
            try:
                asyncio.run(remote.checkpoint(row.path, timeout=timeout))
            except (ActorStopped, NoSuchActor) as error:  # It may have ended since the rows were read.
                failed += [str(error)] if row.path in named else []
            except HoldfastError as error:
                failed.append(str(error))
            else:
                saved += 1
    if as_json:
        show_json({"saved": saved, "failed": failed})
    else:
        typer.echo(f"{saved} of {saved + len(failed)} saved")
    if failed:
        raise ended("checkpoint", "; ".join(failed), FAILED)


# -- how --------------------------------------------------------------------------------------------------------------


def _each(do: Callable[[str], Any], rows: Sequence[ActorRow]) -> None:
    for row in rows:
        do(row.path)


def _transact(
    remote: RemoteSystem, collect: Callable[[RemoteChange], Any], dry_run: bool, timeout: float, as_json: bool
) -> None:
    """Carry out what is collected as one transaction, and show it."""

    async def main() -> RemoteChange:
        async with remote.transaction(dry_run=dry_run, timeout=timeout) as change:
            collect(change)
        return change

    show_change(asyncio.run(main()), dry_run=dry_run, as_json=as_json)


def show_change(change: RemoteChange, *, dry_run: bool, as_json: bool, lost: list[str] | None = None) -> None:
    """The steps of a transaction, how the tree has changed, and of a file (`lost`) what is lost by it."""
    if as_json:
        steps = [dataclasses.asdict(step) for step in change.steps]
        told = {"dry_run": dry_run, "steps": steps, "difference": list(change.difference)}
        show_json(told if lost is None else {**told, "lost": lost})
        return
    typer.echo(change.describe())
    for line in (lost or ()) if dry_run else ():
        typer.echo(f"! {line}")
    typer.echo("nothing was done: this was a dry run" if dry_run else "done")
