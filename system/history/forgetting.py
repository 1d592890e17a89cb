"""Which past events tell of an address that is forgotten: its own, and those of others that name it or its crash."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

from ...checkpoint.addresses import is_at
from .past_event import PastEvent

REMOTE_CRASH = "RemoteCrash"
"""How those name the crash of another actor who have ended because of it."""
LEAST_TEXT = 8
"""Characters of the words of a crash that are looked for elsewhere."""


def telling_of(events: Iterable[PastEvent], top: str) -> set[int]:
    """The numbers of the past events that tell of an address, or of one below it.

    These are events of those addresses, and events that name one of them; further, events of the supervisors above
    that name the child, and of whoever repeats the words of a crash: a supervisor above, or an actor that has asked.

    Args:
        events: all there are.
        top: the address.
    """
    known = list(events)
    own = [event for event in known if is_at(event.address, top)]
    crashes = {
        reason
        for event in own
        if event.fields.get("reason_kind") == "Crash" and isinstance(reason := event.fields.get("reason"), str)
    }
    crashes = {text for text in crashes if len(text) >= LEAST_TEXT}
    named = re.compile(rf"{re.escape(top)}(?![\w-])")
    child = re.compile(rf"(?<![\w-]){re.escape(top.rpartition('/')[2])}(?![\w-])")

    def tells(event: PastEvent) -> bool:
        texts = list(_texts(event))
        if any(named.search(text) for text in texts):
            return True
        is_above = is_at(top, event.address)
        if is_above and any(child.search(text) for text in texts):
            return True
        repeats = is_above or any(REMOTE_CRASH in text for text in texts)
        return repeats and any(crash in text for crash in crashes for text in texts)

    return {event.number for event in own} | {event.number for event in known if tells(event)}


def _texts(event: PastEvent) -> Iterator[str]:
    for value in event.fields.values():
        if isinstance(value, str):
            yield value
        elif isinstance(value, (list, dict)):
            yield from value
