"""Replay: what was handled since the snapshot is fed again, as fast as it goes or as it once came, and compared.

What a turn sends and replies then has the checksum that it had. What an earlier version of the program has coded
otherwise is coded so once more, as far as that is known.

Source: Zou and Bai, who wait between two messages as long as there was between them when they were recorded.
"""

from __future__ import annotations

import asyncio
import itertools
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING

import msgspec

from ...actors.events import ReplayPaced
from ..inputs import Input, Turn
from ..protocol import LEADS_NOWHERE, REPLY, Answer, Out, answer_digest
from ..schema import shape_name
from ..upgrade.mapping import NotMapped, in_whole_numbers
from ..upgrade.present_classes import REFUSAL, REPLY_TO

if TYPE_CHECKING:
    from .present_life import LifePort
    from .switch import Switch

Due = tuple[float, int, Turn]
"""When a turn is to be fed, on the loop's clock, and its number."""
TELL_EVERY = 1.0
"""Seconds between two events that tell how long a paced replay will still take, at least."""


class PacedReplay:
    """The replay to the present life of one home."""

    def __init__(self, home: Switch) -> None:
        self._home = home
        self._handle: asyncio.TimerHandle | None = None
        self._told_at = float("-inf")
        self._fed = -1  # the last turn that was fed
        self._spent = deque[tuple[int, str]]()

    def begin(self, port: LifePort, turns: Iterable[tuple[int, Turn]], then: Callable[[], None]) -> None:
        """Feed ended turns in turn order, then call `then`.

        Each is due as long after the first as it was when they were recorded, divided by the speed: a handler that
        takes its time does not add to that, and all of it never takes longer than what was recorded did.
        """
        self._spent = deque(self._home.ledger.spent())
        speed = self._home.method.speed
        if not speed:
            for number, turn in turns:
                self._feed(port, number, turn)
            then()
            return
        due = self._home.node.loop.time()
        last: float | None = None
        waiting = deque[Due]()
        for number, turn in turns:
            when = turn.input.time
            if last is not None and when > last:  # Turns need not be in the order of admission; clocks may be set back.
                due += (when - last) / speed
            last = when if last is None else max(last, when)
            waiting.append((due, number, turn))
        self._told_at = float("-inf")
        self._go_on(port, waiting, then)

    def _feed(self, port: LifePort, number: int, turn: Turn) -> None:
        pipes = self._home.ledger.pipes_done.get(number, ())
        feed = turn.input.feed(number, tuple(sorted(pipes)), was_asked=turn.reply != 0)
        feed.spent = self.spent_before(number)
        port.to_life(feed)
        self._fed = number

    def spent_before(self, turn: float) -> tuple[str, ...]:
        """The timers that have come in turns before this one, which a replay leaves out, and that were not told."""
        spent: list[str] = []
        while self._spent and self._spent[0][0] < turn:
            spent.append(self._spent.popleft()[1])
        return tuple(spent)

    def pauses_at(self, turn: int) -> bool:
        """Whether all that was fed is handled, up to this turn, and it is not yet time for the next."""
        return self._handle is not None and self._fed <= turn

    def _go_on(self, port: LifePort, waiting: deque[Due], then: Callable[[], None]) -> None:
        home = self._home
        self._handle = None
        if home.life.port is not port:
            return  # That life is over, or not the one any more.
        now = home.node.loop.time()
        while waiting and waiting[0][0] <= now:
            _, number, turn = waiting.popleft()
            self._feed(port, number, turn)
        if not waiting:
            then()
            return
        if home.node.events.has_listeners and now - self._told_at >= TELL_EVERY:
            self._told_at = now
            home.node.emit(ReplayPaced(home.path, len(waiting), waiting[-1][0] - now, home.ledger.backlog(-1)))
        self._handle = home.node.loop.call_at(waiting[0][0], self._go_on, port, waiting, then)

    def cancel(self) -> None:
        """Feed nothing more: that life is over."""
        if self._handle is not None:
            self._handle.cancel()
            self._handle = None


# -- comparing ------------------------------------------------------------------------------------------------------


def is_as_before(home: Switch, out: Out, digest: int) -> bool:
    """Whether a replayed output is the one of a digest but for what may have changed since.

    Its binding leads elsewhere now, its receiver has moved, or its class has other fields, or another name. It is taken
    for the same if its class has lost a field, or one has another type: how it was coded cannot be known then.
    """
    addresses = home.homes.addresses
    led = addresses.led.alike(addresses.key(home.path), out.to)
    receivers = (out.to, *led, *addresses.known_as(out.to))

    def is_same(name: str, body: bytes) -> bool:
        made = (msgspec.structs.replace(out, to=to, name=name, body=body).digest() for to in receivers)
        return any((one ^ digest) & ~LEADS_NOWHERE == 0 for one in made)

    if is_same(out.name, out.body):
        return True
    if out.verb == "wait":
        return any(is_same("|".join(names), b"") for names in _former_waits(home, out.name.split("|")))
    if out.verb != "reply":
        return _is_any(home, out.name, out.body, is_same)
    kind, _, name = out.name.partition("|")
    answer = Answer(kind, _asked(home, int(out.to)) if kind == REPLY else name, out.body)
    return _is_any(home, shape_name(answer), out.body, lambda old, body: is_same(_reply_name(kind, old), body))


def is_same_reply(home: Switch, source: Input, digest: int, answer: Answer) -> bool:
    """Whether the reply to an input is the one of a digest but for what may have changed since, as `is_as_before`."""
    if digest == answer_digest(answer):
        return True
    name = shape_name(Answer(answer.kind, source.name if answer.kind == REPLY else answer.name))

    def is_same(old: str, body: bytes) -> bool:
        own = old.removeprefix(REFUSAL) if answer.kind == "refusal" else answer.name
        return answer_digest(Answer(answer.kind, own, body)) == digest

    return _is_any(home, name, answer.body, is_same)


def _is_any(home: Switch, name: str, body: bytes, is_same: Callable[[str, bytes], bool]) -> bool:
    """Whether one of the older forms of what has this name is the same; also if there was one that is not known."""
    try:
        forms = itertools.chain(((name, body),), home.shapes.older_forms(name, body))
        return any(is_same(old, one) or is_same(old, in_whole_numbers(one)) for old, one in forms)
    except NotMapped:
        return True


def _former_waits(home: Switch, names: list[str]) -> Iterator[tuple[str, ...]]:
    """The classes that a turn waits for, under all names that they have had."""
    return itertools.product(*((name, *home.shapes.former_names(name)) for name in names))


def _asked(home: Switch, key: int) -> str:
    """The type of the message that was input `key`; "" if that is not known any more."""
    return next((source.name for source in home.ledger.handled_and_open() if source.id == key), "")


def _reply_name(kind: str, old: str) -> str:
    """How an output that is a reply names its class."""
    return f"{kind}|{old.removeprefix(REFUSAL)}" if not old.startswith(REPLY_TO) else f"{kind}|"
