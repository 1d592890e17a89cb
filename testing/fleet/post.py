"""The post of a simulated fleet: what programs send each other gets lost, is late, and comes twice, by one seed."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from contextvars import Context, copy_context
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, TypeVar

from ..schedules.choices import Choices, Dice
from .broker import LATENCY
from .frame_faults import AS_USUAL, Fate

T = TypeVar("T")
Take = Callable[[bytes, str], None]


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


class Hearer(NamedTuple):
    """Who listens at a place, by which way, and the context in which it hears."""

    by: SimTransport
    take: Take
    context: Context


class SimPost:
    """Carries bytes between the places of one simulated fleet: to all who listen there.

    Attributes:
        faults: how often what goes wrong; may be changed at any time.
        latency: seconds that bytes take, at least and at most; may be changed, too.

    Args:
        seed: decides all that is drawn.
        faults: how often what goes wrong.
        choices: of a simulated run: keeps what is drawn.
    """

    def __init__(
        self,
        seed: int = 0,
        faults: PostFaults = NO_POST_FAULTS,
        *,
        latency: tuple[float, float] = LATENCY,
        choices: Choices | None = None,
    ) -> None:
        self.faults, self.latency = faults, latency
        self._dice = Dice("post", seed, choices)
        self._hearers: dict[str, list[Hearer]] = {}
        self._cuts: list[frozenset[object]] = []
        self._splits: list[frozenset[object]] = []
        self._due: dict[tuple[str, str], float] = {}
        self._places = 0
        self._nowhere = Context()  # What is on its way arrives, whatever becomes of the program that has sent it.

    def transport(self, owner: object = None, fate: Callable[[str], Fate] = lambda to: AS_USUAL) -> SimTransport:
        """A way to the post.

        Args:
            owner: whose it is, as `cut` and `split` know it.
            fate: asked what becomes of what is sent to a place.
        """
        self._places += 1
        return SimTransport(self, f"place {self._places}", owner, fate)

    def listen(self, at: str, hearer: Hearer) -> None:
        """Have what is sent to a place taken there, by this one, too."""
        self._hearers.setdefault(at, []).append(hearer)

    def forget(self, transport: SimTransport) -> None:
        """Have it hear nothing any more."""
        for at, hearers in self._hearers.items():
            self._hearers[at] = [one for one in hearers if one.by is not transport]

    def cut(self, one: object, other: object) -> None:
        """Let nothing through between two owners any more."""
        self._cuts.append(frozenset((one, other)))

    def split(self, some: frozenset[object]) -> None:
        """Let nothing through between some owners and all others."""
        self._splits.append(some)

    def unite(self, some: frozenset[object]) -> None:
        """Let everything through again between some owners and all others."""
        self._splits.remove(some)

    def heal(self) -> None:
        """Let everything through again, whoever was cut off or split."""
        self._cuts.clear()
        self._splits.clear()

    def post(self, sender: SimTransport, to: str, data: bytes, back: str) -> None:
        """Carry bytes to a place."""
        faults, dice = self.faults, self._dice
        copies, late = sender.fate(to)
        if not copies or dice.strikes(faults.lost):
            return
        way = (sender.place, to)
        due = max(asyncio.get_running_loop().time() + dice.seconds(*self.latency), self._due.get(way, 0.0))
        if late or dice.strikes(faults.late):
            self._carry(due + (late or dice.seconds(0.0, faults.late_seconds)), sender, to, data, back)
        else:
            self._due[way] = due  # Behind what went the same way before.
            self._carry(due, sender, to, data, back)
        if copies > 1 or dice.strikes(faults.doubled):
            self._carry(due + (late or dice.seconds(0.0, faults.late_seconds)), sender, to, data, back)

    def _carry(self, when: float, sender: SimTransport, to: str, data: bytes, back: str) -> None:
        cuts, splits = [*self._cuts], [*self._splits]  # What is sent across one of these is lost, also if that heals.
        loop = asyncio.get_running_loop()
        loop.call_at(when, self._arrive, sender.owner, cuts, splits, to, data, back, context=self._nowhere)

    def _arrive(
        self,
        sender: object,
        cuts: list[frozenset[object]],
        splits: list[frozenset[object]],
        to: str,
        data: bytes,
        back: str,
    ) -> None:
        for hearer in tuple(self._hearers.get(to, ())):
            owner = hearer.by.owner
            is_lost = hearer.by.is_cut or any({sender, owner} == pair for pair in (*cuts, *self._cuts))
            if not is_lost and all((sender in some) == (owner in some) for some in (*splits, *self._splits)):
                hearer.context.run(hearer.take, data, back)


class SimTransport:
    """One program's way to the post of its fleet; see `cluster.lines.lines.Transport`.

    Attributes:
        place: where it is reached itself.
        owner: whose it is.
        fate: asked what becomes of what is sent to a place.
        is_cut: whether nothing goes out or comes in at the moment.
        is_mute: whether nothing goes out.
        most_bytes: the most that is carried at once, in bytes.
    """

    def __init__(self, post: SimPost, place: str, owner: object, fate: Callable[[str], Fate]) -> None:
        self._post, self.place, self.owner, self.fate = post, place, owner, fate
        self.is_cut = self.is_mute = False
        self.most_bytes = MOST_BYTES

    def post(self, to: str, data: bytes, back: str) -> None:
        """Send bytes to a place; see `Transport`."""
        if not self.is_cut and not self.is_mute:
            self._post.post(self, to, data, back)

    async def hear(self, at: str, take: Take) -> None:
        """Listen at a place; see `Transport`."""
        self._post.listen(at, Hearer(self, take, copy_context()))

    async def unless_denied(self, work: Coroutine[Any, Any, T]) -> T:
        """Here everybody may send everywhere."""
        return await work

    def own_place(self) -> str:
        """The place of this program alone; see `Transport`."""
        return self.place

    async def close(self) -> None:
        """Hear nothing any more; see `Transport`."""
        self._post.forget(self)
