"""The commands that ask a running system about its past: why, history, events, dead-letters, quarantine."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, TypeVar

import msgspec
import typer

from ..actors.errors import HoldfastError
from ..system import PastEvent, PastLife
from .operate import FAILED, UNUSABLE
from .remote import NotReached, RemoteSystem
from .wire import WrongUser

T = TypeVar("T")

ONE_LOOK = 30.0
"""Seconds that one request of `--follow` waits for the next event."""
HIDDEN = frozenset({"traceback", "reason_kind"})
"""Fields of events that stand in `--json` only: their line would become too long."""
UNPRINTED = dict.fromkeys((*range(32), *range(127, 160)), "?")
"""Characters that make a terminal do something."""

Socket = Annotated[Path, typer.Option("--socket", help="The control endpoint of the running system.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
Address = Annotated[str, typer.Argument(help="An address, such as /app/bank/alice.")]
Pattern = Annotated[str, typer.Argument(help="An address, or a pattern such as '/app/bank/**'.")]
Limit = Annotated[int, typer.Option("--limit", min=1, max=1000, help="How many, the newest.")]


def why(path: Address, socket: Socket, json: Json = False) -> None:
    """Say in a few sentences why an actor restarts, has ended, or does not get on."""
    sentences = _asked("why", socket, lambda system: asyncio.run(system.why(path)))
    if json:
        _print_json({"address": path, "why": sentences})
    else:
        _print_lines(sentences)


def history(path: Address, socket: Socket, json: Json = False) -> None:
    """List the last lives of an actor: when each began and ended, why, and by whom."""
    lives = _asked("history", socket, lambda system: system.lives(path))
    if json:
        _print_json({"address": path, "lives": lives})
    else:
        _print_lines(map(life_line, lives) if lives else [f"the history knows of no life at {path}"])


def events(
    socket: Socket,
    path: Pattern = "**",
    kinds: Annotated[list[str] | None, typer.Option("--kind", help="Only this kind of event; may be repeated.")] = None,
    seconds: Annotated[
        float | None, typer.Option("--last", min=0.0, help="Only what was told in so many last seconds.")
    ] = None,
    limit: Limit = 50,
    follow: Annotated[bool, typer.Option("--follow", help="Go on with events as they come, until Ctrl+C.")] = False,
    json: Json = False,
) -> None:
    """Print past events, oldest first; with --json one object on each line."""

    def ask(system: RemoteSystem) -> None:
        since = 0.0 if seconds is None else time.time() - seconds
        page = system.history(path, kinds=kinds or (), since=since, limit=limit)
        _print_events(page.events, json=json)
        while follow:
            page = asyncio.run(system.follow_history(path, kinds=kinds or (), after=page.next, timeout=ONE_LOOK))
            _print_events(page.events, json=json)

    try:
        _asked("events", socket, ask)
    except KeyboardInterrupt:
        return  # This is how one ends it.


def dead_letters(socket: Socket, path: Pattern = "**", limit: Limit = 50, json: Json = False) -> None:
    """Print the messages that nobody handled, or that were refused: type, sender, and why."""
    page = _asked("dead-letters", socket, lambda system: system.history(path, kinds=["DeadLetter"], limit=limit))
    _print_events(page.events, json=json)


def quarantine(
    socket: Socket,
    path: Annotated[str | None, typer.Argument(help="An address; without one, of all.")] = None,
    json: Json = False,
) -> None:
    """List the messages that were put aside because they have ended their actor's process again and again."""
    messages = _asked("quarantine", socket, lambda system: system.put_aside(path))
    if json:
        _print_json({"quarantine": messages})
        return
    for one in messages:
        sender = f" from {one.sender}" if one.sender else ""
        payload = f": {one.payload}" if one.payload else ""
        _print_lines([f"{moment(one.since)} {one.address} {one.message}{sender}, {one.attempts} deaths{payload}"])


def _asked(command: str, socket: Path, ask: Callable[[RemoteSystem], T]) -> T:
    """What the running system answers. Exit status 1: it refuses; 2: it cannot be reached."""
    try:
        with RemoteSystem(socket) as system:
            return ask(system)
    except (NotReached, WrongUser) as error:
        raise _failed(command, error, UNUSABLE) from error
    except HoldfastError as error:
        raise _failed(command, error, FAILED) from error


def _failed(command: str, error: Exception, code: int) -> typer.Exit:
    typer.echo(f"holdfast {command}: {error}", err=True)
    return typer.Exit(code)


def _print_json(value: object) -> None:
    typer.echo(msgspec.json.encode(value).decode())


def _print_lines(lines: Iterable[str]) -> None:
    for line in lines:
        typer.echo(line.translate(UNPRINTED))


def _print_events(found: Iterable[PastEvent], *, json: bool) -> None:
    for event in found:
        if json:
            _print_json(event)
        else:
            _print_lines([event_line(event)])


def event_line(event: PastEvent) -> str:
    """A past event as a line of text.

    >>> event_line(PastEvent(7, 0.0, "ActorStarted", "/app/till", {"life": 2})).split()[2:]
    ['7', '/app/till', 'ActorStarted', 'life=2']
    """
    fields = " ".join(f"{name}={value}" for name, value in event.fields.items() if name not in HIDDEN)
    return f"{moment(event.at)} {event.number} {event.address} {event.kind} {fields}".rstrip()


def life_line(life: PastLife) -> str:
    """A past life as a line of text.

    >>> life_line(PastLife(2, started=None, ended=0.0, reason="no such file")).partition(": ")[2]
    'not started, no such file'
    """
    began = "not started" if life.started is None else moment(life.started)
    parts = [f"life {life.number}: {began}"]
    if life.ended is None:
        parts.append("goes on")
    else:
        if life.started is not None:
            parts.append(f"ended {moment(life.ended)}")
        parts.append(life.reason)
        parts += [f"handling {life.handling}"] if life.handling else []
        parts += [f"by {life.by} ({life.because})"] if life.by else []
        parts += [f"restart {life.restarts} of {life.allowed}"] if life.restarts is not None else []
    parts += [f"recovered in {sum(life.phases.values()):.3f} s, {life.replayed} replayed"] if life.phases else []
    return ", ".join(parts)


def moment(at: float) -> str:
    """A moment as local time, with milliseconds."""
    return f"{time.strftime('%Y-%m-%d %H:%M:%S', time.localtime(at))}.{int(at % 1 * 1000):03d}"
