"""The command that follows the messages of one actor: trace."""

from __future__ import annotations

import contextlib
import time
from typing import Annotated, Any

import typer

from .reaching import FAILED, Json, OnePath, Socket, System, ended, meant_rows, reached, show_json

SLICE = 1.0
"""Seconds that one request for more waits."""


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
