"""Past events, past lives and messages in quarantine, each as one line of text."""

from __future__ import annotations

import time

from ...actors.values.path_parts import CONTROL
from ...system import LoggedLine, PastEvent, PastLife
from ...system.history.evidence import PutAside

HIDDEN = frozenset({"traceback", "reason_kind", "turns", "longest_turn", "longest_message"})
"""Fields of events that stand in `--json` only: their line would become too long."""

ESCAPED = {code: f"\\x{code:02x}" if code < 256 else f"\\u{code:04x}" for code in CONTROL if code != ord("\t")}
"""What stands for characters in what a process has printed that a terminal would obey instead of showing them."""


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
    >>> life_line(PastLife(2, ended=0.0, started=0.0, reason="killed", by="the program")).rpartition(", ")[2]
    'by the program'
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
        parts += [f"by {life.author}"] if life.by else []
        parts += [f"restart {life.restarts} of {life.allowed}"] if life.restarts is not None else []
    parts += [f"{life.turns} turns"] if life.turns is not None else []
    parts += [f"the longest {life.longest_turn:.1f} s with {life.longest_message}"] if life.longest_message else []
    parts += [f"recovered in {sum(life.phases.values()):.3f} s, {life.replayed} replayed"] if life.phases else []
    return ", ".join(parts)


def log_line(line: LoggedLine) -> str:
    """A line that a process has printed, or holdfast has logged, as a line of text.

    >>> log_line(LoggedLine(1, 0.0, "/app/till", "stderr", "warning", "no\\x1b[31m paper", 2)).split(" ", 2)[2]
    '/app/till life 2 stderr: no\\\\x1b[31m paper'
    """
    life = f" life {line.life}" if line.life else ""
    tag = line.level if line.source == "holdfast" else line.source
    return f"{moment(line.at)} {line.address}{life} {tag}: {line.text.translate(ESCAPED)}"


def moment(at: float) -> str:
    """A moment as local time, with milliseconds."""
    return f"{time.strftime('%Y-%m-%d %H:%M:%S', time.localtime(at))}.{int(at % 1 * 1000):03d}"


def quarantine_line(one: PutAside) -> str:
    """A message in quarantine as a line of text, its number behind its address.

    >>> quarantine_line(PutAside("/app/till", "shop.Pay", 3, 0.0, "/app/clerk", 7)).split(" ", 2)[2]
    '/app/till 7 shop.Pay from /app/clerk, 3 deaths'
    """
    sender = f" from {one.sender}" if one.sender else ""
    payload = f": {one.payload}" if one.payload else ""
    return f"{moment(one.since)} {one.address} {one.id} {one.message}{sender}, {one.attempts} deaths{payload}"
