"""The base of all observers: a new one is one class.

It says what it sees by `verdict` or `say`; when that is published, renewed and taken back is decided here.
"""

from __future__ import annotations

from collections.abc import Awaitable, Collection
from typing import Any, Final

import msgspec

from ...actors.exit_reasons import Crash, ExitReason
from ...actors.kernel.actor import Actor, on, subscribe
from ...actors.kernel.message import Message
from ..literals import Literal, atom_of, literal_of
from ..messages import GRACE, OBSERVATIONS, OBSERVERS, Grace, ObserverCrashed
from ..observations import Observation
from .hearing import Heard, listen
from .verdicts import Agreement, Debounce

RENEWALS: Final = 3
"""How often a literal is said again within its time to live."""


class Manner(msgspec.Struct, frozen=True, kw_only=True):
    """The habits of an observer: how often it looks, and when it believes what it sees.

    Attributes:
        every: seconds between two looks; silence is seen by looking.
        time_to_live: seconds after which what it said is unknown if it does not say it again.
        agreement: how many of how many samples must agree before it says something else.
        grace: seconds after its start in which nothing bad is said.
    """

    every: float = 1.0
    time_to_live: float = 5.0
    agreement: Agreement = Agreement()
    grace: float = 0.0

    def __post_init__(self) -> None:
        if not (0 < self.every <= self.time_to_live / RENEWALS and self.grace >= 0):
            raise ValueError(
                f"an observer looks every {self.every:g} s, and what it says lives {self.time_to_live:g} s: that must "
                f"be {RENEWALS} times as long at least, or it would be forgotten in between"
            )


class Look(Message):
    """It is time to look."""


class _Word:
    """What was said of one atom, or of the trend of one value."""

    __slots__ = ("debounce", "said", "since", "time")

    def __init__(self, agreement: Agreement) -> None:
        self.debounce = Debounce[Literal](agreement)
        self.said: Literal | None = None
        self.since: float | None = None
        self.time = 0.0


class Observer(Actor):
    """Sees something and says so on `/observations`.

    Override `hear`, which gets what is published on `topics`, or `look`, which is called every so often, or both, and
    call `verdict` in them. It needs nothing of what it observes.

    Args:
        topics: what it hears.
        manner: how often it looks, and when it believes what it sees.
    """

    deterministic = False

    def __init__(self, *topics: str, manner: Manner | None = None) -> None:
        self.topics = tuple(dict.fromkeys(topics))
        self.manner = manner or Manner()
        self._words: dict[Literal, _Word] = {}
        self._grace: dict[str, float] = {}
        self._outbox: list[Observation] = []

    # -- for those who write an observer ----------------------------------------------------------------------------

    def hear(self, topic: str, message: Any) -> None:
        """A message was published on one of the topics."""

    def look(self) -> Awaitable[None] | None:
        """Look at what is observed, as is done every so often; may be async."""

    def spares(self, grace: Grace, about: Literal) -> bool:
        """Say whether a grace is for what is said of this."""
        return not set(grace.names).isdisjoint(about.args)

    def afresh(self, names: Collection[str]) -> None:
        """Somebody has acted upon some of what is observed: forget what was gathered of it before.

        `names` are the components, topics and values that this is about, none of which is to be blamed yet.
        """

    @property
    def now(self) -> float:
        """Seconds on the loop clock (T67)."""
        return self.ctx._cell.node.loop.time()

    @property
    def age(self) -> float:
        """Seconds since this observer began."""
        return self.now - self._began

    def verdict(self, atom: Literal | str, holds: bool | None, since: float | None = None) -> None:
        """Take one more sample: the atom (`ok("disk")`, or "ok(disk)") holds, or does not, or (None) nothing is known.

        Args:
            atom: what this is about.
            holds: whether it does.
            since: when that began which shows it, on the loop clock; None if that is not known. What has lasted for
                long when it is said need not be looked at for long before repair acts on it.

        Raises:
            BadLiteral: the text is no atom. TypeError: it is neither an atom nor a text.
        """
        about = atom_of(atom)
        self.say(about, None if holds is None else about if holds else ~about, since)

    def say(self, about: Literal | str, literal: Literal | str | None, since: float | None = None) -> None:
        """Take one more sample of something of which different literals can be said, such as the trend of a value."""
        about, literal = literal_of(about), None if literal is None else literal_of(literal)
        word = self._words.get(about)
        if word is None:
            word = self._words[about] = _Word(self.manner.agreement)
        word.since = since
        settled = word.debounce(literal)
        if settled is not None or literal is None or literal != word.said:  # What is seen again is not taken back.
            self._settle(word, settled)

    def said(self, about: Literal | str) -> bool | None:
        """Return what was settled of an atom: it holds, or does not, or (None) it is unknown."""
        word = self._words.get(literal_of(about))
        settled = word.debounce.settled if word is not None else None
        return None if settled is None else settled.positive

    # -- the rest ---------------------------------------------------------------------------------------------------

    def on_start(self, restored: bool) -> None:
        """Begin to hear and to look."""
        self._began = self.now
        for topic in self.topics:
            listen(self, topic)
        self.ctx.every(self.manner.every, Look())
        self.ctx.ref.tell(Look())

    async def on_stop(self, reason: ExitReason) -> None:
        """Tell the diagnoser of a crash."""
        if isinstance(reason, Crash):
            await self.ctx.publish(OBSERVERS, ObserverCrashed(self.ctx.path, str(reason)))

    @on(Heard)
    def _heard(self, message: Heard) -> Any:
        self.hear(message.topic, message.message)
        return self._publish() if self._outbox else None

    @on(Look)
    async def _look(self, message: Look) -> None:
        seen = self.look()
        if seen is not None:
            await seen
        await self._publish()

    @subscribe(GRACE)
    @on(Grace)
    async def _spare(self, message: Grace) -> None:
        now = self.now
        self._grace = {name: until for name, until in self._grace.items() if until > now}
        spared = {about: word for about, word in self._words.items() if self.spares(message, about)}
        left_out = {name for about in self._words if about not in spared for name in about.args}
        until = dict.fromkeys((name for name in message.names if name not in left_out), now + message.seconds)
        self._grace |= {name: max(self._grace.get(name, 0.0), end) for name, end in until.items()}
        if spared:
            self.afresh({name for about in spared for name in about.args})
        for word in spared.values():
            word.debounce.clear()  # samples from before say nothing about after
            if word.said is not None and not word.said.positive:
                self._settle(word, None)
        await self._publish()

    def _settle(self, word: _Word, settled: Literal | None) -> None:
        now = self.now
        if settled is not None and not settled.positive and self._is_spared(settled, now):
            settled = None
        if settled is None:
            if word.said is not None:  # A word that dies at once: it is unknown from now on.
                self._outbox.append(Observation(word.said, now, self.ctx.path, 0.0))
                word.said = None
        elif settled != word.said or now - word.time >= self.manner.time_to_live / RENEWALS:
            word.said, word.time = settled, now
            self._outbox.append(Observation(settled, now, self.ctx.path, self.manner.time_to_live, word.since))

    def _is_spared(self, literal: Literal, now: float) -> bool:
        return now < self._began + self.manner.grace or any(now < self._grace.get(name, 0.0) for name in literal.args)

    async def _publish(self) -> None:
        outbox, self._outbox = self._outbox, []
        for observation in outbox:
            await self.ctx.publish(OBSERVATIONS, observation)
