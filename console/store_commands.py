"""The commands for a store on the disk: `holdfast store verify | backup | restore`."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from ..actors.errors import HoldfastError
from ..checkpoint.journal import DamagedStore, ForeignStore
from ..checkpoint.store_tools import StoreCopy, Verification, back_up_store, restore_store, verify_store

DAMAGED = 1
UNREADABLE = 2

store = typer.Typer(
    name="store", help="Look after a store: verify it, copy it, bring a copy back.", no_args_is_help=True
)

StorePath = Annotated[Path, typer.Argument(help="The database of a store: app.db, as in store='sqlite:app.db'.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]


@store.command()
def verify(path: StorePath, as_json: Json = False) -> None:
    """Read every byte of a store that counts, and compare all checksums. Nothing is changed.

    A running system may have the store open: then one instant of it is verified.

    Exit status 0: all is good. 1: something is damaged. 2: there is no store, or it cannot be read.
    """
    try:
        found = verify_store(path)
    except HoldfastError as error:
        raise _ended("verify", error, UNREADABLE) from error
    _show_verification(found, as_json=as_json)
    if not found.is_good:
        raise typer.Exit(DAMAGED)


@store.command()
def backup(
    path: StorePath,
    dest: Annotated[Path, typer.Argument(help="The database of the copy, which must not be there.")],
    check: Annotated[bool, typer.Option("--verify/--no-verify", help="Verify the copy when it is made.")] = True,
    as_json: Json = False,
) -> None:
    """Copy a store as it is at one instant, also while a system runs on it. The copy is a store of its own.

    Exit status 0: the copy is there, and good. 1: the store is damaged; a copy that was made is damaged as it is.
    2: there is no copy: there is no store, it cannot be read, or DEST cannot be written.
    """
    _copy("backup", lambda: back_up_store(path, dest), check=check, as_json=as_json)


@store.command()
def restore(
    path: Annotated[Path, typer.Argument(metavar="BACKUP", help="The database of the backup; it stays as it is.")],
    dest: Annotated[Path, typer.Argument(help="The database to be made, which must not be there.")],
    as_json: Json = False,
) -> None:
    """Verify a backup, and copy it to where a system will open it. Nothing is ever overwritten.

    Exit status 0: done. 1: the copy is damaged. 2: the backup is damaged or cannot be read, or DEST cannot be written.
    """
    _copy("restore", lambda: restore_store(path, dest), check=True, as_json=as_json)


def _copy(command: str, make: Callable[[], StoreCopy], *, check: bool, as_json: bool) -> None:
    try:
        copy = make()
        found = verify_store(copy.path) if check else None
    except (DamagedStore, ForeignStore) as error:
        raise _ended(command, error, DAMAGED) from error
    except HoldfastError as error:
        raise _ended(command, error, UNREADABLE) from error
    if as_json:
        verified = None if found is None else _as_data(found)
        typer.echo(json.dumps({**dataclasses.asdict(copy), "verified": verified}))
    else:
        typer.echo(f"{copy.path}: the store {copy.identity}, a copy of {copy.origin or 'one without identity'}")
        typer.echo(f"up to position {copy.last}; {copy.files} snapshot files, {copy.size} bytes")
        if found is not None:
            _show_verification(found, as_json=False)
    if found is not None and not found.is_good:
        raise typer.Exit(DAMAGED)


def _show_verification(found: Verification, *, as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps(_as_data(found)))
        return
    for damage in found.damages:
        typer.echo(f"DAMAGED {damage}")
    if found.untold:
        typer.echo(f"DAMAGED and {found.untold} more")
    read = f"{found.entries} entries, {found.snapshots} snapshots, {found.packs} packs"
    opened = f"; as it was at one instant, for process {found.pid} has it open" if found.pid else ""
    verdict = "good" if found.is_good else f"DAMAGED in {len(found.damages) + found.untold} places"
    typer.echo(f"{found.path}: {verdict}: {read}, up to position {found.last}{opened}")


def _as_data(found: Verification) -> dict[str, Any]:
    return {"is_good": found.is_good, **dataclasses.asdict(found)}


def _ended(command: str, error: HoldfastError, status: int) -> typer.Exit:
    typer.echo(f"holdfast store {command}: {error}", err=True)
    return typer.Exit(status)
