"""The command that says what is wrong with a running system, as its own diagnosis sees it: diagnose."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec
import typer

from .reaching import FAILED, ONE, Json, Socket, System, address_of, alone, complete_path, ended, reached, show_json
from .remembering import print_lines
from .told_lines import moment


def diagnose(
    path: Annotated[
        str | None,
        typer.Argument(
            help=f"{ONE}; only suspects there and below are told.", autocompletion=complete_path, callback=alone
        ),
    ] = None,
    system: System = None,
    socket: Socket = None,
    watch: Annotated[bool, typer.Option("--watch", help="Go on when it changes, until Ctrl+C.")] = False,
    seconds: Annotated[float, typer.Option(min=0.1, max=3600.0, help="With --watch: between two looks.")] = 1.0,
    png: Annotated[
        Path | None, typer.Option("--png", help="Draw the time line of the newest case, or of that of --case.")
    ] = None,
    case: Annotated[int | None, typer.Option(min=1, help="With --png: the number of the case.")] = None,
    timeout: Annotated[float, typer.Option(min=0.1, max=3600.0, help="Seconds that a diagnosis may take.")] = 5.0,
    as_json: Json = False,
) -> None:
    """Say what is wrong with a running system, since when and why, what would be done, and what was done.

    Exit status 0: it has said something, good or bad. 1: no diagnosis runs, or it knows nobody there. 2: no system.
    """
    last: list[dict[str, Any]] | None = None
    try:
        with reached("diagnose", system, socket) as remote, asyncio.Runner() as runner:
            path = path and address_of(remote, path)
            while True:
                found = runner.run(remote.diagnosis(path, timeout=timeout))
                if png is not None:
                    _draw(found, case, png)
                if found != last:
                    _show(found, is_line=watch, as_json=as_json)
                last = found
                if not watch:
                    return
                time.sleep(seconds)
    except KeyboardInterrupt:
        return  # This is how one ends it.


def _draw(found: list[dict[str, Any]], case: int | None, path: Path) -> None:
    """Draw a case. Raises typer.Exit: there is none, or it cannot be drawn."""
    from ...diagnosis.repair import Story  # only now: no other command needs the planner
    from ...diagnosis.repair.timeline import draw_story

    told = [story for one in found if one["repair"] for story in one["repair"]["stories"]]
    stories = [msgspec.convert(story, Story) for story in told if case in (None, story["case"])]
    if not stories:
        raise ended("diagnose", "there is no such case to draw: `holdfast diagnose` lists them", FAILED)
    try:
        draw_story(stories[-1], path)
    except ImportError as error:
        raise ended("diagnose", "a picture needs matplotlib: pip install 'holdfast[programs]'", FAILED) from error
    except OSError as error:
        raise ended("diagnose", f"{path} cannot be written: {error.strerror or error}", FAILED) from error


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
        yield from (f"  {line}" for line in suspect_lines(suspect))
    if not one["suspects"]:
        yield f"none of {one['components']} components is suspected"
    yield from (f"why: {line}" for line in one["why"].splitlines() if line.strip())
    yield from (f"look next at: {each['atom']} ({each['gain_bits']:.2f} bits)" for each in one["next_best"])
    yield from (f"not understood: {each}" for each in one["refused"])
    if one["repair"]:
        yield from case_lines(one["repair"])


NUMBERS: Final = ("nobody", "one actor", "two actors", "three actors", "four actors", "five actors")


def suspect_lines(suspect: dict[str, Any]) -> Iterator[str]:
    """What is to be said of one suspect: since when, who waits for it, what it does now, what repair makes of it."""
    if suspect["since"] is not None:
        yield f"suspected since {moment(suspect['since'])}"
    if suspect["unanswered_seconds"] is not None:
        count, names = suspect["waiting_count"], suspect["waiting"]
        who = NUMBERS[count] if count < len(NUMBERS) else f"{count} actors"
        named = "".join([": ", ", ".join(names), " and others" if count > len(names) else ""]) if names else ""
        waits = f"{who} wait{'s' if count == 1 else ''} for it{named}" if count else "no actor waits for it"
        yield f"`{suspect['address']}` has not answered for {suspect['unanswered_seconds']:.1f} s; {waits}"
    if suspect["now"]:
        yield suspect["now"]
    repair = suspect["repair"]
    if repair["would"]:
        yield f"plan: {repair['would']}"
    yield from (f"done: {text}" for text in repair["done"])
    if repair["denied"]:
        yield f"denied: {repair['denied']} (`holdfast repair retry {suspect['component']}` takes that back)"


def case_lines(repair: dict[str, Any]) -> Iterator[str]:
    """How far repair goes, and what it has told of the newest case, each sentence with its time."""
    yield f"repair: {repair['stance']}"
    for story in repair["stories"][-1:]:
        yield f"case {story['case']}, since {moment(story['entries'][0]['time'])}:"
        yield from (f"  {moment(entry['time'])} {entry['text']}" for entry in story["entries"])
