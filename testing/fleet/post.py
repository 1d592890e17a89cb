"""The post of a simulated fleet: what programs send each other gets lost, is late, and comes twice, by one seed."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Any, Final, TypeVar

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class PostFaults:
    """How often what goes wrong: a share of what is posted, from 0 to 1.

    Attributes:
        lost: never arrives.
        doubled: arrives twice, the second time up to `late_seconds` later.
        late: arrives up to `late_seconds` later, behind what was posted after it.
        late_seconds: how late that may be, in seconds.
    """

    lost: float = 0.0
    doubled: float = 0.0
    late: float = 0.0
    late_seconds: float = 2.0


MOST_BYTES: Final = 8 * 1024 * 1024
"""What is carried at once, in bytes, unless a test says otherwise."""
NO_POST_FAULTS: Final = PostFaults()


class SimPost:
    """Carries bytes between the places of one simulated fleet.

    Attributes:
        faults: how often what goes wrong; may be changed at any time.

    Args:
        seed: decides all that is drawn.
        faults: how often what goes wrong.
        latency: seconds that bytes take, at least and at most.
    """

    def __init__(
        self, seed: int = 0, faults: PostFaults = NO_POST_FAULTS, *, latency: tuple[float, float] = (0.0002, 0.003)
    ) -> None:
        self.faults, self.latency = faults, latency
        self._draw = random.Random(f"post {seed}")
        self._hearers: dict[str, Callable[[bytes, str], None]] = {}
        self._due: dict[tuple[str, str], float] = {}
        self._places = 0

    def transport(self) -> SimTransport:
        """A program's way to the post."""
        self._places += 1
        return SimTransport(self, f"place {self._places}")

    def listen(self, at: str, take: Callable[[bytes, str], None]) -> None:
        """Have what is sent to a place taken there, by this one alone from now on."""
        self._hearers[at] = take

    def forget(self, take: Callable[[bytes, str], None]) -> None:
        """Have it hear nothing any more."""
        self._hearers = {at: one for at, one in self._hearers.items() if one is not take}

    def post(self, sender: str, to: str, data: bytes, back: str) -> None:
        """Carry bytes to a place."""
        loop, faults, draw = asyncio.get_running_loop(), self.faults, self._draw
        now = loop.time()
        if draw.random() < faults.lost:
            return
        way = (sender, to)
        due = max(now + draw.uniform(*self.latency), self._due.get(way, 0.0))
        if draw.random() < faults.late:
            loop.call_at(due + draw.uniform(0.0, faults.late_seconds), self._arrive, to, data, back)
        else:
            self._due[way] = due  # Behind what went the same way before.
            loop.call_at(due, self._arrive, to, data, back)
        if draw.random() < faults.doubled:
            loop.call_at(due + draw.uniform(0.0, faults.late_seconds), self._arrive, to, data, back)

    def _arrive(self, to: str, data: bytes, back: str) -> None:
        take = self._hearers.get(to)
        if take is not None:
            take(data, back)


class SimTransport:
    """One program's way to the post of its fleet; see `cluster.lines.lines.Transport`.

    Attributes:
        is_cut: whether nothing goes out or comes in at the moment.
        is_mute: whether nothing goes out.
        most_bytes: the most that is carried at once, in bytes.
    """

    def __init__(self, post: SimPost, place: str) -> None:
        self._post, self._place = post, place
        self._takes: list[Callable[[bytes, str], None]] = []
        self.is_cut = self.is_mute = False
        self.most_bytes = MOST_BYTES

    def post(self, to: str, data: bytes, back: str) -> None:
        """Send bytes to a place; see `Transport`."""
        if not self.is_cut and not self.is_mute:
            self._post.post(self._place, to, data, back)

    async def hear(self, at: str, take: Callable[[bytes, str], None]) -> None:
        """Listen at a place; see `Transport`."""

        def taken(data: bytes, back: str) -> None:
            if not self.is_cut:
                take(data, back)

        self._takes.append(taken)
        self._post.listen(at, taken)

    async def unless_denied(self, work: Coroutine[Any, Any, T]) -> T:
        """Here everybody may send everywhere."""
        return await work

    def own_place(self) -> str:
        """The place of this program alone; see `Transport`."""
        return self._place

    async def close(self) -> None:
        """Hear nothing any more; see `Transport`."""
        for take in self._takes:
            self._post.forget(take)
