"""The commands that follow what actors do and say: trace, logs."""

from __future__ import annotations

import asyncio
import contextlib
import datetime
import re
import time
from collections.abc import Iterable
from enum import StrEnum
from typing import Annotated, Any, Final

import msgspec
import typer

from ...system import LoggedLine
from ..remote import RemoteSystem
from .reaching import (
    FAILED,
    UNUSABLE,
    Json,
    OnePath,
    Patterned,
    Socket,
    System,
    address_of,
    ended,
    meant_rows,
    reached,
    show_json,
)
from .told_lines import log_line

SLICE = 1.0
"""Seconds that one request for more waits."""
ONE_WAIT: Final = 30.0
"""Seconds that one request of `logs --follow` waits for the next line."""
AGO: Final = re.compile(r"(?P<number>\d+(?:\.\d+)?)(?P<unit>[smhd]?)")
SECONDS: Final = {"": 1.0, "s": 1.0, "m": 60.0, "h": 3600.0, "d": 86_400.0}


Last = Annotated[int, typer.Option("--last", min=1, max=1000, help="How many, the newest.")]
Since = Annotated[
    str | None,
    typer.Option("--since", metavar="WHEN", help="Only since then: 90s, 10m, 2h, 1d ago, or 2026-01-31T12:00."),
]


class LogLevel(StrEnum):
    """How grave a line is."""

    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"
    CRITICAL = "critical"


def trace(
    path: OnePath,
    system: System = None,
    socket: Socket = None,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="How long; until Ctrl+C if left out.")] = None,
    most: Annotated[int | None, typer.Option("--count", min=1, help="End after so many lines.")] = None,
    as_json: Json = False,
) -> None:
    """Follow one actor: what comes in, the turns it runs and how long they take, and what it sends.

    It goes on over restarts. With --json each line is one JSON object. The content of messages is shown.

    Exit status 0: the time is over, or the actor has ended for good. 1: nobody is there. 2: no system answers.
    """
    until = None if seconds is None else time.monotonic() + seconds
    shown = missed = 0
    with reached("trace", system, socket) as remote, contextlib.suppress(KeyboardInterrupt):
        row, *others = meant_rows(remote, [path])
        if others:
            raise ended("trace", f"{path} means {1 + len(others)} actors: name the one to follow", FAILED)
        remote.follow(row.path)
        if row.turn:
            typer.echo(
                f"its turn of {row.turn} has run for {row.turn_seconds:.0f} s: only what it sends is shown", err=True
            )
        while until is None or time.monotonic() < until:
            told = remote.next_events(SLICE if until is None else max(0.01, min(SLICE, until - time.monotonic())))
            for event in told["events"]:
                show_json(event) if as_json else typer.echo(event_line(event))
                shown += 1
                if shown == most:
                    return
            if told["missed"] > missed:
                typer.echo(f"{told['missed'] - missed} events came too fast and are not shown", err=True)
                missed = told["missed"]
            if told["is_over"]:
                return


def logs(
    path: Patterned = "**",
    system: System = None,
    socket: Socket = None,
    follow: Annotated[
        bool, typer.Option("--follow", "-f", help="Go on with lines as they come, until Ctrl+C.")
    ] = False,
    last: Last = 50,
    since: Since = None,
    level: Annotated[LogLevel, typer.Option(help="Only lines as grave as this: stdout is info, stderr warning.")] = (
        LogLevel.DEBUG
    ),
    as_json: Json = False,
) -> None:
    """Print the last lines that actors' processes have printed, and what holdfast has logged, oldest first.

    Each says which life of the actor it is from. With --json each line is one JSON object.

    Exit status 0: done. 1: nobody is there, and nothing is kept of it. 2: no system answers.
    """
    begin = begin_meant("logs", since)
    with reached("logs", system, socket) as remote, contextlib.suppress(KeyboardInterrupt):
        path = address_of(remote, path)
        page = remote.logs(path, level=level.value, since=begin, limit=last)
        print_log(page.lines, as_json=as_json)
        if not page.lines and not follow:
            why_empty(remote, path)
        with asyncio.Runner() as runner:  # One loop: a Ctrl+C that comes while one is made is told on standard error.
            while follow:
                page = runner.run(remote.follow_logs(path, level=level.value, after=page.next, timeout=ONE_WAIT))
                if page.dropped:
                    typer.echo(f"{page.dropped} lines came too fast and are not shown", err=True)
                print_log(page.lines, as_json=as_json)


def why_empty(remote: RemoteSystem, path: str) -> None:
    """Say why no line is there: nobody is, or nobody who prints. Raises typer.Exit: nobody is there."""
    if not {*"*?["} & {*path} and path not in remote.tree() and not remote.logs(path, limit=1).lines:
        raise ended("logs", f"nobody is at {path}, and no line is kept of it", FAILED)
    typer.echo("no such line is kept; what actors print that have no process of their own is not kept here", err=True)


def print_log(lines: Iterable[LoggedLine], *, as_json: bool) -> None:
    """Print lines as text, or each as a JSON object."""
    for line in lines:
        typer.echo(msgspec.json.encode(line).decode() if as_json else log_line(line))


def begin_meant(command: str, since: str | None) -> float:
    """The Unix time that `--since` means, 0 if it is left out. Raises typer.Exit: it means none."""
    try:
        return 0.0 if since is None else moment_meant(since, time.time())
    except ValueError as error:
        raise ended(command, f"--since: {error}", UNUSABLE) from error


def moment_meant(text: str, now: float) -> float:
    """The Unix time that is meant by so long ago, or by a date and time, which is local if it does not say otherwise.

    Raises:
        ValueError: it is neither of these.

    >>> moment_meant("90", 1000.0), moment_meant("2m", 1000.0), moment_meant("1970-01-01T00:00:07+00:00", 1000.0)
    (910.0, 880.0, 7.0)
    """
    ago = AGO.fullmatch(text)
    if ago is not None:
        return now - float(ago["number"]) * SECONDS[ago["unit"]]
    try:
        return datetime.datetime.fromisoformat(text).timestamp()
    except (ValueError, OverflowError, OSError) as error:
        known = "90s, 10m, 2h or 1d ago, nor a date and time such as 2026-01-31T12:00"
        raise ValueError(f"{text!r} is neither {known}") from error


def event_line(event: dict[str, Any]) -> str:
    """An event of a trace in a line."""
    at = time.strftime("%H:%M:%S", time.localtime(event["at"])) + f"{event['at'] % 1:.3f}"[1:]
    match event["what"]:
        case "MessageIn":
            return f"{at} in    {event['message']}"
        case "TurnBegan":
            return f"{at} turn  {event['message']}"
        case "TurnEnded":
            return (
                f"{at} ended {event['type'].rpartition('.')[2]}, {event['seconds'] * 1000:.1f} ms, {event['outcome']}"
            )
        case "MessageOut":
            return f"{at} out   {event['message']} to {event['to']}"
        case other:
            return f"{at} {other}"
