"""The commands that ask a running system about its past: why, history, events, dead-letters."""

from __future__ import annotations

import asyncio
import difflib
from collections.abc import Iterable
from typing import Annotated

import msgspec
import typer

from ... import events as events_of_all
from ...system import PastEvent
from .following import Last, Since, begin_meant
from .reaching import (
    FAILED,
    UNUSABLE,
    Json,
    OnePath,
    Patterned,
    RootOrOne,
    Socket,
    System,
    address_of,
    ended,
    no_pattern,
    printable,
    reached,
    show_json,
)
from .told_lines import event_line, life_line

ONE_LOOK = 30.0
"""Seconds that one request of `--follow` waits for the next event."""
KINDS = frozenset(events_of_all.__all__) | {"SystemStarted", "SystemStopped", "EventsLeftOut"}
"""The names of the events that there are."""


def why(path: RootOrOne = None, system: System = None, socket: Socket = None, as_json: Json = False) -> None:
    """Say in a few sentences why an actor restarts, has ended, or does not get on; left out, the root is meant."""
    with reached("why", system, socket) as remote:
        path = address_of(remote, path or f"/{remote.about()['name']}")
        sentences = asyncio.run(remote.why(path))
        if not remote.lives(path) and path not in remote.tree():
            raise ended("why", " ".join(sentences) + no_pattern(path), FAILED)
    if as_json:
        show_json({"address": path, "why": sentences})
    else:
        print_lines(sentences)


def history(path: OnePath, system: System = None, socket: Socket = None, as_json: Json = False) -> None:
    """List the last lives of an actor: when each began and ended, why, and by whom."""
    with reached("history", system, socket) as remote:
        path = address_of(remote, path)
        lives = remote.lives(path)
        if not lives:
            raise ended("history", f"the history knows of no life at {path}{no_pattern(path)}", FAILED)
    if as_json:
        show_json({"address": path, "lives": msgspec.to_builtins(lives)})
    else:
        print_lines(map(life_line, lives))


def events(
    path: Patterned = "**",
    system: System = None,
    socket: Socket = None,
    kinds: Annotated[list[str] | None, typer.Option("--kind", help="Only this kind of event; may be repeated.")] = None,
    last: Last = 50,
    since: Since = None,
    follow: Annotated[bool, typer.Option("--follow", help="Go on with events as they come, until Ctrl+C.")] = False,
    as_json: Json = False,
) -> None:
    """Print past events, oldest first; with --json one object on each line."""
    wrong = sorted(set(kinds or ()) - KINDS)
    if wrong:
        known = difflib.get_close_matches(wrong[0], KINDS)
        hint = f"; there are {', '.join(known)}" if known else ", as docs/events.md lists them"
        raise ended("events", f"there is no kind of event {wrong[0]!r}{hint}", UNUSABLE)
    begin = begin_meant("events", since)
    try:
        with reached("events", system, socket) as remote:
            path = address_of(remote, path)
            page = remote.history(path, kinds=kinds or (), since=begin, limit=last)
            _print_events(page.events, as_json=as_json)
            if not page.events and not follow and not as_json:
                print_lines([], none="no such event is kept")
            while follow:
                asked = remote.follow_history(path, kinds=kinds or (), after=page.next, timeout=ONE_LOOK)
                page = asyncio.run(asked)
                _print_events(page.events, as_json=as_json)
    except KeyboardInterrupt:
        return  # This is how one ends it.


def dead_letters(
    path: Patterned = "**",
    system: System = None,
    socket: Socket = None,
    last: Last = 50,
    since: Since = None,
    as_json: Json = False,
) -> None:
    """Print the messages that nobody handled, or that were refused: type, sender, and why."""
    begin = begin_meant("dead-letters", since)
    with reached("dead-letters", system, socket) as remote:
        path = address_of(remote, path)
        page = remote.history(path, kinds=["DeadLetter"], since=begin, limit=last)
    _print_events(page.events, as_json=as_json)
    if not page.events and not as_json:
        print_lines([], none="no such dead letter is kept")


def print_lines(lines: Iterable[str], *, none: str = "") -> None:
    """Print lines as a terminal may have them; if there is none, say so on standard error."""
    shown = [printable(line) for line in lines]
    for line in shown:
        typer.echo(line)
    if not shown and none:
        typer.echo(none, err=True)


def _print_events(found: Iterable[PastEvent], *, as_json: bool) -> None:
    for event in found:
        if as_json:
            typer.echo(msgspec.json.encode(event).decode())
        else:
            print_lines([event_line(event)])
