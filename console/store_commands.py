"""The `holdfast store` commands, for a store on the disk: verify it, count, copy, print, erase and compact."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import errno
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from ..actors.errors import HoldfastError
from ..checkpoint.home.disposal import Erased
from ..checkpoint.journal import DamagedStore, NotCopied, StoreInUse
from ..checkpoint.store_tools import (
    StoreCopy,
    StoreStats,
    Verification,
    back_up_store,
    compact_store,
    export_store,
    rekey_store,
    restore_store,
    store_stats,
    verify_store,
)
from ..cluster.configuration import read_configuration
from ..cluster.joining import is_same_store, open_store, other_systems
from ..system.stored_erasure import erase_stored
from .operate.reaching import Yes, confirm
from .service.store_options import KeyFile, StorePath, file_path

DAMAGED = 1
UNREADABLE = 2

store = typer.Typer(
    name="store",
    help="Look after a store: verify it, copy it, bring a copy back.",
    no_args_is_help=True,
    add_completion=False,
)


NewKeyFile = Annotated[Path | None, typer.Option("--new-key-file", help="The file with the key of the copy.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]


@store.command()
def verify(path: StorePath, key_file: KeyFile = None, as_json: Json = False) -> None:
    """Read every byte of a store that counts, and compare all checksums. Nothing is changed.

    A running system may have the store open: then one instant of it is verified.

    Exit status 0: all is good. 1: something is damaged. 2: there is no store, or it cannot be read.
    """
    try:
        found = verify_store(path, key=key_file)
    except HoldfastError as error:
        raise _ended("verify", error, UNREADABLE) from error
    _show_verification(found, as_json=as_json)
    if not found.is_good:
        raise typer.Exit(DAMAGED)


@store.command()
def stats(path: StorePath, key_file: KeyFile = None, as_json: Json = False) -> None:
    """Print what is recorded of each address, how much room it takes, and what waits. Nothing is changed.

    Exit status 0: done. 1: something is damaged. 2: there is no store, or it cannot be read.
    """
    try:
        found = store_stats(path, key=key_file)
    except DamagedStore as error:
        raise _ended("stats", error, DAMAGED) from error
    except HoldfastError as error:
        raise _ended("stats", error, UNREADABLE) from error
    if as_json:
        typer.echo(json.dumps(dataclasses.asdict(found)))
    else:
        _show_stats(found)
    if any(one.damage for one in found.addresses):
        raise typer.Exit(DAMAGED)


def _show_stats(found: StoreStats) -> None:
    opened = f"open in process {found.pid}" if found.pid else "not open"
    typer.echo(f"{found.path}: the store {found.identity or 'without identity'}, format {found.version}, {opened}")
    if found.origin:
        typer.echo(f"a copy of {found.origin}, made {_moment(found.copied_at)}")
    typer.echo(f"opened {found.epoch} times; the newest position is {found.last}; {found.notes} notes")
    typer.echo(", ".join(f"{name} {_bytes(size)}" for name, size in found.files.items()))
    rows: list[tuple[str, ...]] = [
        ("address", "class", "turns", "waiting", "entries", "bytes", "snapshots", "bytes", "newest")
    ]
    for one in found.addresses:
        newest = _moment(one.snapshots[-1].time) if one.snapshots else "-"
        size = sum(snapshot.size for snapshot in one.snapshots)
        counts = one.turns, one.waiting, one.entries, _bytes(one.size), len(one.snapshots), _bytes(size)
        rows.append((one.address, one.kind or "-", *map(str, counts), newest))
    entries, size = sum(one.entries for one in found.addresses), sum(one.size for one in found.addresses)
    kept = [snapshot.size for one in found.addresses for snapshot in one.snapshots]
    waiting = sum(one.waiting for one in found.addresses)
    totals = "", waiting, entries, _bytes(size), len(kept), _bytes(sum(kept)), ""
    rows.append((f"{len(found.addresses)} addresses", "", *map(str, totals)))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = (
            text.ljust(width) if place < 2 else text.rjust(width)
            for place, (text, width) in enumerate(zip(row, widths, strict=True))
        )
        typer.echo("  ".join(cells).rstrip())
    for one in found.addresses:
        if one.damage:
            typer.echo(f"DAMAGED {one.address}: {one.damage}; `holdfast store verify` tells more")


def _moment(when: float) -> str:
    if not when:
        return "-"
    seconds = max(0, round(time.time() - when))
    age = f"{seconds} s" if seconds < 120 else f"{seconds // 60} min" if seconds < 7200 else f"{seconds // 3600} h"
    return f"{time.strftime('%Y-%m-%d %H:%M:%S', time.localtime(when))} ({age} ago)"


def _bytes(size: float) -> str:
    """Write a number of bytes for people.

    >>> _bytes(999), _bytes(2_500_000)
    ('999 B', '2.5 MB')
    """
    for unit in ("B", "kB", "MB"):
        if size < 1000:
            return f"{size:.0f} B" if unit == "B" else f"{size:.1f} {unit}"
        size /= 1000
    return f"{size:.1f} GB"


@store.command()
def export(path: StorePath, key_file: KeyFile = None) -> None:
    """Print everything that a store has, one JSON object a line. Nothing is changed, and no class is imported.

    What is encrypted in the store is printed in plain text.

    Exit status 0: done. 1: something is damaged; it is a line of its own. 2: there is no store, or it cannot be read.
    """
    is_damaged = False
    try:
        for record in export_store(path, key=key_file):
            is_damaged = is_damaged or record["record"] == "damage"
            typer.echo(json.dumps(record))
    except DamagedStore as error:
        raise _ended("export", error, DAMAGED) from error
    except HoldfastError as error:
        raise _ended("export", error, UNREADABLE) from error
    except OSError as error:
        if error.errno == errno.EPIPE:  # Whoever reads it has enough, as `head` has.
            raise
        raise _ended("export", HoldfastError(f"the output cannot be written: {error}"), UNREADABLE) from error
    if is_damaged:
        raise typer.Exit(DAMAGED)


@store.command()
def compact(path: StorePath, key_file: KeyFile = None, as_json: Json = False) -> None:
    """Give back the room of what a store does not need. No system may have it open.

    Exit status 0: done. 1: it is in use, or damaged. 2: there is no store, it cannot be read, or there is no room.
    """
    try:
        done = compact_store(path, key=key_file)
    except (DamagedStore, StoreInUse) as error:
        raise _ended("compact", error, DAMAGED) from error
    except HoldfastError as error:
        raise _ended("compact", error, UNREADABLE) from error
    if as_json:
        typer.echo(json.dumps(dataclasses.asdict(done)))
    else:
        typer.echo(f"{done.path}: {_bytes(done.before)} before, {_bytes(done.after)} now")


@store.command()
def erase(
    path: StorePath,
    address: Annotated[str, typer.Argument(help="An address: /app/tenants/acme means that one, and all below it.")],
    key_file: KeyFile = None,
    yes: Yes = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only count what would be forgotten.")] = False,
    as_json: Json = False,
) -> None:
    """Forget everything that a store has of an address and of all below it, and give back the room.

    That is what `system.erase` does, also in a copy of a store; then no file of the store has its bytes any more. No
    system may have it open.

    Exit status 0: done, or there is nothing. 1: the store is in use or damaged, or nobody has said yes. 2: there is no
    store, it cannot be read, or there is no room.
    """

    def erased(*, dry_run: bool) -> Erased:
        return asyncio.run(
            erase_stored(open_store(f"sqlite:{path}", is_new=False, key=key_file), address, dry_run=dry_run)
        )

    try:
        found = erased(dry_run=True)
        if not dry_run:
            confirm("store erase", [f"this is forgotten for good: {_erased(found)}"], yes=yes)
            found = erased(dry_run=False)
            compact_store(path, key=key_file)
    except (DamagedStore, StoreInUse) as error:
        raise _ended("erase", error, DAMAGED) from error
    except HoldfastError as error:
        raise _ended("erase", error, UNREADABLE) from error
    if as_json:
        typer.echo(json.dumps(dataclasses.asdict(found)))
    else:
        typer.echo(f"{path}: {_erased(found)} {'would be forgotten' if dry_run else 'forgotten'}")


def _erased(found: Erased) -> str:
    return (
        f"{found.address}: {found.addresses} addresses, {found.children} notes of children, "
        f"{found.put_aside} messages in quarantine, {found.events} events of the history, {found.others} other notes"
    )


@store.command()
def backup(
    path: StorePath,
    dest: Annotated[
        Path, typer.Argument(help="The database of the copy, which must not be there.", callback=file_path)
    ],
    check: Annotated[bool, typer.Option("--verify/--no-verify", help="Verify the copy when it is made.")] = True,
    key_file: KeyFile = None,
    as_json: Json = False,
) -> None:
    """Copy a store as it is at one instant, also while a system runs on it. The copy is a store of its own.

    That of an encrypted store is encrypted with the same key.

    Exit status 0: the copy is there, and good. 1: the store is damaged; a copy that was made is damaged as it is.
    2: there is no copy: there is no store, it cannot be read, or DEST cannot be written.
    """
    _copy("backup", lambda: back_up_store(path, dest, key=key_file), check=check, key=key_file, as_json=as_json)


@store.command()
def restore(
    path: Annotated[
        Path,
        typer.Argument(metavar="BACKUP", help="The database of the backup; it stays as it is.", callback=file_path),
    ],
    dest: Annotated[Path, typer.Argument(help="The database to be made, which must not be there.", callback=file_path)],
    key_file: KeyFile = None,
    as_json: Json = False,
) -> None:
    """Verify a backup, and copy it to where a system will open it. Nothing is ever overwritten.

    Exit status 0: done. 1: the copy is damaged. 2: the backup is damaged or cannot be read, or DEST cannot be written.
    """
    _copy("restore", lambda: restore_store(path, dest, key=key_file), check=True, key=key_file, as_json=as_json)


@store.command("copy")
def copy(
    source: Annotated[str, typer.Argument(metavar="STORE", help="As in `store=`: sqlite:PATH or nats://HOST/NAME.")],
    dest: Annotated[str, typer.Argument(metavar="DEST", help="The same, of a store that has nothing yet.")],
    key_file: KeyFile = None,
    new_key_file: NewKeyFile = None,
    other_name: Annotated[
        bool, typer.Option("--other-name", help="Copy to a place on servers that is named after another system.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Copy what one store has into another one, between a file and servers, both ways, and compare the two.

    No system may have either of them open. The copy is there completely, or not at all. It is encrypted if there is
    --new-key-file. How servers are reached is said in their address, or by holdfast.toml and the environment.

    Exit status 0: done. 2: STORE is not there, one of them is open, damaged or cannot be reached, or DEST has something
    already or is another system's.
    """
    from ..cluster.store_copy import copy_store

    try:
        settings = read_configuration().nats.told()
        names = source.partition("?")[0], dest.partition("?")[0]
        if is_same_store(source, dest):
            raise NotCopied(*names, "both are one store", "name another one as DEST")
        with contextlib.ExitStack() as stack:
            first = stack.enter_context(contextlib.closing(open_store(source, settings, is_new=False, key=key_file)))
            theirs = other_systems(first, source, dest)
            if theirs and not other_name:  # Before anything is made there.
                problem = f"that is the place of another system, and what is copied is of {theirs}"
                raise NotCopied(*names, problem, "name the place of that one, or give --other-name")
            second = stack.enter_context(contextlib.closing(open_store(dest, settings, key=new_key_file)))
            made = copy_store(first, second, names=names)
    except HoldfastError as error:
        raise _ended("copy", error, UNREADABLE) from error
    if as_json:
        typer.echo(json.dumps(made._asdict()))
    else:
        counts = f"{made.addresses} addresses, {made.snapshots} snapshots, {made.entries} entries, {made.notes} notes"
        typer.echo(f"copied {counts}")


@store.command()
def rekey(
    path: StorePath,
    dest: Annotated[Path, typer.Argument(help="The database to be made, which must not be there.")],
    key_file: KeyFile = None,
    new_key_file: NewKeyFile = None,
    plain: Annotated[bool, typer.Option("--plain", help="Make a copy that is not encrypted.")] = False,
    as_json: Json = False,
) -> None:
    """Verify a store, and make a copy of it with another key, or of a plain one an encrypted one.

    No system may have the store open. It stays as it is: remove it yourself.

    Exit status 0: done. 1: the copy is damaged. 2: the store is damaged, open or cannot be read, or DEST cannot be
    written.
    """
    if plain == (new_key_file is not None):
        raise _ended("rekey", HoldfastError("name either --new-key-file or --plain"), UNREADABLE)
    _copy(
        "rekey",
        lambda: rekey_store(path, dest, key=key_file, new_key=new_key_file),
        check=True,
        key=new_key_file,
        as_json=as_json,
    )


def _copy(command: str, make: Callable[[], StoreCopy], *, check: bool, key: Path | None, as_json: bool) -> None:
    try:
        copy = make()
        found = verify_store(copy.path, key=key) if check else None
    except DamagedStore as error:
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
