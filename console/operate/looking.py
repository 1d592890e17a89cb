"""The commands that look at running systems: ls, tree, inspect."""

from __future__ import annotations

import asyncio
import sys
import time
from collections.abc import Iterator
from typing import Annotated, Any

import msgspec
import typer

from ...actors.errors import AskTimeout
from ...system.history.paths import literal
from ..overview import ActorRow, ProcessUse, SystemLook
from ..remote import RemoteSystem
from ..runtime_folder import found_sockets, sweep
from .patterns import select
from .reaching import (
    FAILED,
    NOBODY,
    OF_ITS_OWN,
    UNUSABLE,
    Json,
    Paths,
    Socket,
    System,
    complete_path,
    ended,
    printable,
    program_at,
    reached,
    show_json,
    told,
)

COLOURS = {"running": "green", "suspended": "yellow", "restarting": "magenta", "starting": "magenta", "stopped": "red"}
MEASURED = 0.2
"""Seconds over which the processor's use is measured."""
STATE_WITHIN = 5.0
"""Seconds in which an actor tells its state"""
BUSY_WITHIN = 0.5
"""or, if a turn of it is in hand: it is told between two turns."""


def ls(as_json: Json = False) -> None:
    """List the running systems of this user that are found by name, and remove what dead ones have left.

    Exit status 0: done, also if there is none. 2: the folder of their sockets is not to be trusted.
    """
    with told("ls"):
        sweep()
        systems = [program_at(one) for one in found_sockets()]
    if as_json:
        show_json([{**msgspec.structs.asdict(one), "socket": str(one.socket)} for one in systems])
        return
    if not systems:
        typer.echo(f"{NOBODY}; {OF_ITS_OWN}", err=True)
    lines = [("NAME", "NODE", "PID", "ROLE", "SINCE", "ACTORS", "STORE")]
    lines += [
        (one.name, one.node or "?", str(one.pid), one.role_text, _when(one.since), _count(one.actors), one.store or "-")
        for one in systems
    ]
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    for line in lines if systems else []:
        typer.echo("  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip())


def _when(seconds: float | None) -> str:
    return "does not answer" if seconds is None else time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(seconds))


def _count(actors: int | None) -> str:
    return "?" if actors is None else str(actors)


def tree(
    patterns: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[PATTERN]...",
            help="Only these: '/app/bank/**', '/app/**[restarts>3]'.",
            autocompletion=complete_path,
        ),
    ] = None,
    system: System = None,
    socket: Socket = None,
    parts: Annotated[bool, typer.Option("--parts", help="Show the parts of the runtime itself, too.")] = False,
    paths: Annotated[bool, typer.Option("--paths", help="Print addresses only, one a line.")] = False,
    as_json: Json = False,
) -> None:
    """Show the actors of a running system as a tree: what they are, how they are, and where they live.

    Exit status 0: done. 1: a pattern fits nobody. 2: no system answers.
    """
    with reached("tree", system, socket) as remote:
        look = remote.look(parts=parts)
        rows = select(look.rows, patterns) if patterns else look.rows
    if as_json:
        show_json(as_plain_look(look, rows))
    elif paths:
        typer.echo("\n".join(printable(literal(row.path)) for row in rows))
    else:
        typer.echo("\n".join(tree_lines(with_ancestors(look.rows, rows), look.processes)))


def as_plain_look(look: SystemLook, rows: list[ActorRow]) -> dict[str, Any]:
    """A look as the JSON output has it."""
    return {
        "system": look.system,
        "pid": look.pid,
        "actors": [msgspec.structs.asdict(row) for row in rows],
        "processes": [msgspec.structs.asdict(use) for use in look.processes],
    }


def with_ancestors(rows: list[ActorRow], wanted: list[ActorRow]) -> list[ActorRow]:
    """Those that are wanted, and whoever is above one of them."""
    if len(wanted) == len(rows):
        return rows
    paths: set[str] = set()
    for row in wanted:
        path = row.path
        while path and path not in paths:
            paths.add(path)
            path = path.rpartition("/")[0]
    return [row for row in rows if row.path in paths]


def tree_lines(rows: list[ActorRow], processes: list[ProcessUse]) -> Iterator[str]:
    """The rows as lines, each below the one above it."""
    memory = {use.pid: use.memory_bytes for use in processes}
    below: dict[str, list[ActorRow]] = {}
    for row in rows:
        below.setdefault(row.path.rpartition("/")[0], []).append(row)
    waiting = [(rows[0], "", "")] if rows else []
    while waiting:
        row, guide, indent = waiting.pop()
        yield f"{guide}{row_line(row, memory.get(row.pid), is_top=not guide)}"
        children = below.get(row.path, [])
        for number, child in enumerate(reversed(children)):
            branch, further = ("└── ", "    ") if number == 0 else ("├── ", "│   ")
            waiting.append((child, indent + branch, indent + further))


def row_line(row: ActorRow, memory_bytes: int | None, *, is_top: bool) -> str:
    """One actor in a line: name, class, state, and what is not as usual."""
    name = row.path if is_top else row.path.rpartition("/")[2]
    said = [typer.style(row.state, fg=COLOURS.get(row.state, "magenta"))]
    if row.place != "task" or is_top:
        said += [f"{row.place} {row.pid or '-'}"] + ([f"{memory_bytes / 1e6:.0f} MB"] if memory_bytes else [])
    said += [typer.style(f"restarts {row.restarts}", fg="yellow")] if row.restarts else []
    said += [f"queued {row.queued}"] if row.queued else []
    at = "rests in" if row.rests else "in"
    said += [f"{at} {printable(_short(row.turn))} for {row.turn_seconds:.1f} s"] if row.turn else []
    said += [row.recovery] if row.recovery else []
    said += [" + ".join(row.mechanism)] if row.mechanism else []
    said += [f"named {printable(', '.join(row.names))}"] if row.names else []
    return f"{typer.style(printable(name), bold=True)}  {printable(_short(row.kind))}  {', '.join(said)}"


def _short(kind: str) -> str:
    return kind.rpartition(".")[2]


def top(
    patterns: Annotated[
        list[str] | None,
        typer.Argument(metavar="[PATTERN]...", help="Only these.", autocompletion=complete_path),
    ] = None,
    system: System = None,
    socket: Socket = None,
    seconds: Annotated[float, typer.Option(min=0.2, max=60.0, help="Between two looks.")] = 1.0,
) -> None:
    """Show a running system on one page, again and again: states, mailboxes, turns, memory, processor.

    Keys: s suspends, r resumes, R restarts, i or Enter shows all of an actor, o changes the order, / takes a pattern.

    Exit status 0: left by q. 1: the system has gone. 2: no system answers.
    """
    from .top import Top  # only now: Textual takes a while to import

    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise ended("top", "it needs a terminal; holdfast tree prints the same once", UNUSABLE)
    with reached("top", system, socket) as remote:
        why = Top(remote, seconds=seconds, patterns=tuple(patterns or ())).run()
    if why:
        raise ended("top", why, FAILED)


def inspect(
    paths: Paths,
    system: System = None,
    socket: Socket = None,
    with_state: Annotated[
        bool, typer.Option("--state", help="Show the state, too: in outline, or in full with --json.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Show all there is to say of actors: status, place, mailbox, turn, ties, bindings, protection, memory, processor.

    Exit status 0: done. 1: nobody is there, or one does not answer. 2: no system answers.
    """
    with reached("inspect", system, socket) as remote:
        rows = select(remote.look(parts=True).rows, paths)
        before, begun = {row.path: remote.inspect(row.path) for row in rows}, time.monotonic()
        time.sleep(max(0.0, MEASURED - (time.monotonic() - begun)))
        found = [_measured(remote.inspect(path), one, time.monotonic() - begun) for path, one in before.items()]
        for one in found:
            if with_state and one["actor"]["pid"]:
                _put_state(remote, one, as_json=as_json)
    if as_json:
        show_json(found)
    else:
        for number, one in enumerate(found):
            typer.echo(("\n" if number else "") + "\n".join(inspection_lines(one)))
    if any("no_state" in one for one in found):
        raise typer.Exit(FAILED)


def _put_state(remote: RemoteSystem, one: dict[str, Any], *, as_json: bool) -> None:
    """With its state, or with what keeps it from being told."""
    row = one["actor"]
    path, within = row["path"], BUSY_WITHIN if row["turn"] or row["state"] == "silent" else STATE_WITHIN
    try:
        one["state"] = (
            remote.state(path, timeout=within) if as_json else asyncio.run(remote.outline(path, timeout=within))
        )
    except AskTimeout as late:
        one["no_state"] = f"not to be had, for {late.turn or 'it does not answer'}"


def _measured(one: dict[str, Any], before: dict[str, Any], seconds: float) -> dict[str, Any]:
    """With the share of one processor that its process has used between two looks."""
    now, then = one.get("process"), before.get("process")
    if now and then and now["pid"] == then["pid"]:
        now["cpu_percent"] = round(100.0 * (now["cpu_seconds"] - then["cpu_seconds"]) / max(seconds, 1e-3), 1)
    return one


def inspection_lines(one: dict[str, Any]) -> Iterator[str]:
    """What is to be said of an actor, a line for each thing; what there is nothing of is left out."""
    row = one["actor"]
    yield f"address: {row['path']}"
    yield f"kind: {row['kind']}"
    yield f"state: {row['state']}"
    yield f"place: {row['place']}, pid {row['pid'] or '-'}"
    yield f"life: {one.get('life', '-')} ({row['restarts']} restarts)"
    yield f"queued: {row['queued']}"
    if row["turn"]:
        at = f", at {one['turn_at']}" if one.get("turn_at") else ""
        rests = f"; it {one['turn_rests']}" if one.get("turn_rests") else ""
        yield f"turn: {row['turn']}, for {row['turn_seconds']:.1f} s{at}{rests}"
    yield f"recovery: {row['recovery'] or 'none'}"
    yield f"protection: {protection_text(one.get('protection'))}"
    for name in ("names", "links", "monitors"):
        told = row["names"] if name == "names" else one.get(name)
        if told:
            yield f"{name}: {', '.join(told)}"
    for port, target in one.get("bindings", {}).items():
        yield f"binding {port}: {target}"
    for name, value in one.get("spec", {}).items():
        yield f"spec {name}: {value}"
    if supervises := one.get("supervises"):
        used = f"{supervises['restarts']} of {supervises['intensity']} restarts within {supervises['period']:g} s"
        yield f"supervises: {supervises['children']} children, {supervises['strategy']}, {used} used up"
    if process := one.get("process"):
        percent = f" ({process['cpu_percent']:g} % now)" if "cpu_percent" in process else ""
        yield f"memory: {process['memory_bytes'] / 1e6:.1f} MB, of its process"
        yield f"processor: {process['cpu_seconds']:.1f} s{percent}, of its process"
    if "state" in one:
        for name, text in one["state"].items():
            yield f"state {name}: {printable(text)}" if name else f"state: {printable(text)}"
    if "no_state" in one:
        yield f"state: {one['no_state']}"


def protection_text(found: dict[str, Any] | None) -> str:
    """How an actor is protected, in a line."""
    if not found:
        return "none"
    replicas = ", ".join(f"{name} {state}" for name, state in found["replicas"].items())
    since = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(found["since"]))
    whole = "whole" if found["is_whole"] else "not whole"
    more = (", changing" if found["is_changing"] else "") + (", on probation" if found["is_on_probation"] else "")
    return (
        f"{' + '.join(found['stack'])}, {whole} since {since}, epoch {found['epoch']} ({replicas or 'starting'}){more}"
    )
