"""Versions, assertions and acceptance tests for the tests of mechanisms: named, as replicas import them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import holdfast as hf
from holdfast.ftm.model.mechanism import load
from tests.ftm.accounts import Add as Count
from tests.ftm.accounts import Counter
from tests.ftm.replicated import Add, Fetch, Total

FAULTY: Any = load(Path(__file__).with_name("faulty.py"))


def is_positive(reply: Any) -> bool:
    return not isinstance(reply, int) or reply >= 0


def has_no_holes(state: Any) -> bool:
    return all(one > -1000 and one != -500 for one in getattr(state, "seen", ()))


def keeps_its_word(reply: Any, message: Any, state: Any) -> bool:
    return not isinstance(message, Add) or (reply == sum(state.seen) and state.seen[-1] == message.n)


def is_never_true(reply: Any) -> bool:
    return False


def tags_are_known(state: Any) -> bool:
    """Of a counter: its total is the sum of what it has added, one for each tag."""
    return state.total == len(state.tags)


def odd_name(reply: Any, who: Any) -> bool:
    return True


class Second(Total):
    """Adds one by one."""

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.seen.append(message.n)
        total = 0
        for one in self.seen:
            total += one
        return total


class Low(Total):
    """Always a little less."""

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.seen.append(message.n - 1)
        return sum(self.seen)


class High(Total):
    """Always a little more."""

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.seen.append(message.n + 1)
        return sum(self.seen)


class Swaying(Total):
    """More in what it says than anybody, and less in what it keeps."""

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.seen.append(message.n - 5)
        return message.n


def last(ballots: Any) -> tuple[int, ...]:
    """A voter: takes the last run, all others may be as they are."""
    return tuple(range(len(ballots)))[::-1]


class Third(Total):
    """Does it by itself too."""

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.seen = [*self.seen, message.n]
        return sum(reversed(self.seen))


class BadAtThirteen(Total):
    """Has a bug: it does not take 13 for what it is."""

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.seen.append(message.n)
        return -13 if message.n == 13 else sum(self.seen)


class BadState(Total):
    """Has a bug that shows in its state only."""

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.seen.append(message.n)
        total = sum(self.seen)
        if message.n == 13:
            self.seen[-1] = 12
        return total


class Crashing(Total):
    """Has a bug that crashes it."""

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.seen.append(message.n)
        return 1 // (message.n - 13) * 0 + sum(self.seen)


class BadAtSeven(Total):
    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.seen.append(message.n)
        return -7 if message.n in (7, 13) else sum(self.seen)


class Curious(Total):
    """Asks what the others do not ask."""

    @hf.on(Add)
    async def add(self, message: Add) -> int:  # type: ignore[override]  # pyright: ignore[reportIncompatibleMethodOverride]
        self.seen.append(message.n)
        if message.n == 13:
            await self.other.ask(Add(1))
        return sum(self.seen)


class Rounded(Total):
    """Comes near."""

    @hf.on(Add)
    def add(self, message: Add) -> int:
        self.seen.append(message.n)
        return sum(self.seen) + 1


class Deaf(hf.Actor):
    """Has not the same messages."""

    @hf.on(Fetch)
    def fetch(self, message: Fetch) -> int:
        return 0


@hf.on(Add)
def add_again(self: Any, message: Add) -> int:
    """A handler in place of the class's own."""
    self.seen.append(message.n)
    return sum(self.seen)


@hf.on(Add)
def add_badly(self: Any, message: Add) -> int:
    self.seen.append(message.n)
    return -1


class SameCounter(Counter):
    """Another one, as far as anybody sees."""


class OtherCounter(Counter):
    """Counts in another way."""

    @hf.on(Count)
    def add(self, message: Count) -> int:
        self.tags = [*self.tags, message.tag]
        self.total = message.amount + self.total
        return self.total


CA = "/app/ca"
SETTINGS: dict[str, dict[str, Any]] = {  # for a Counter, of the mechanisms that do not go without
    "ad": {"assertions": (tags_are_known,)},
    "rb": {"alternates": (SameCounter,), "test": (tags_are_known,)},
    "nvp": {"versions": (SameCounter, OtherCounter)},
    "sec": {"authority": CA},
}
