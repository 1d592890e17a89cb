"""The command that says what is wrong with a running system, as its own diagnosis sees it: diagnose."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Iterator
from typing import Annotated, Any

import typer

from .reaching import Json, Socket, System, complete_path, reached, show_json
from .remembering import print_lines


def diagnose(
    path: Annotated[
        str | None,
        typer.Argument(
            metavar="[PATH]", help="Only suspects at this address and below it.", autocompletion=complete_path
        ),
    ] = None,
    system: System = None,
    socket: Socket = None,
    watch: Annotated[bool, typer.Option("--watch", help="Go on when it changes, until Ctrl+C.")] = False,
    seconds: Annotated[float, typer.Option(min=0.1, max=3600.0, help="With --watch: between two looks.")] = 1.0,
    timeout: Annotated[float, typer.Option(min=0.1, max=3600.0, help="Seconds that a diagnosis may take.")] = 5.0,
    as_json: Json = False,
) -> None:
    """Say what the diagnosis of a running system says now: what is suspected, why, and what to look at next.

    Exit status 0: it has said something, good or bad. 1: no diagnosis runs, or it knows nobody there. 2: no system.
    """
    last: list[dict[str, Any]] | None = None
    try:
        with reached("diagnose", system, socket) as remote:
            while True:
                found = asyncio.run(remote.diagnosis(path, timeout=timeout))
                if found != last:
                    _show(found, is_line=watch, as_json=as_json)
                last = found
                if not watch:
                    return
                time.sleep(seconds)
    except KeyboardInterrupt:
        return  # This is how one ends it.


def _show(found: list[dict[str, Any]], *, is_line: bool, as_json: bool) -> None:
    """Print it; with --watch each JSON document is one line."""
    if not as_json:
        for one in found:
            print_lines(diagnosis_lines(one))
    elif is_line:
        typer.echo(json.dumps(found, ensure_ascii=False))
    else:
        show_json(found)


def diagnosis_lines(one: dict[str, Any]) -> Iterator[str]:
    """What one diagnoser says, a line for each thing; what there is nothing of is left out."""
    yield f"{one['diagnoser']}: {one['text']}"
    for suspect in one["suspects"]:
        where = f" at {suspect['address']}" if suspect["address"] else ""
        yield f"{'faulty' if suspect['is_certain'] else 'perhaps faulty'}: {suspect['component']}{where}"
    if not one["suspects"]:
        yield f"none of {one['components']} components is suspected"
    yield from (f"why: {line}" for line in one["why"].splitlines() if line.strip())
    yield from (f"look next at: {each['atom']} ({each['gain_bits']:.2f} bits)" for each in one["next_best"])
    yield from (f"not understood: {each}" for each in one["refused"])
