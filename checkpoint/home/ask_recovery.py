"""Reconnects what was under way between recorded actors when the root ended: asks, and messages to who is not up yet.

The receiver's journal says of such an input whose turn asks, (turn, k). So the receiver, whose home may be open first,
answers to whoever that is: to the asker's home if that is open, else into the asker's journal, where it finds it.
What the receiver never had (its mailbox was full, say) ends at its deadline: it may have been forwarded, so it is not
asked again. An ask of another system is answered to that, and comes again until it has its outcome.

Whom a turn tells or asks something may not have been started by the new program yet. The message is kept for it in its
journal, and becomes an input when its home is opened.
"""

from __future__ import annotations

import math
from hashlib import blake2b
from time import monotonic
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

import msgspec

from ...actors.errors import HoldfastError
from ...actors.kernel.codec import Parcel
from ...actors.kernel.envelope import Ask
from ..inputs import Batch, Input
from ..protocol import MESSAGE, Answer, Out
from ..schema import shape_entry
from .input_ledger import outcome_entry
from .pending_asks import MARK, OVER, SwitchAsk

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from ...actors.kernel.codec import Codec
    from .homes import Homes
    from .switch import Switch


FAR: Final = "far"
"""The address of far answers in the store; no actor's, for those begin with a slash."""
SYSTEM: Final = "connected "
"""How the key of a fact begins that names a system to which there was a line."""
PASSING: Final = "/client~"
"""How the addresses of programs begin that are no systems, and only connect to some."""
TIDIED: Final = 1024
"""Asks under way after which it is looked for some that have run out."""
MOST_ENTRIES: Final = 2000
"""Entries after which what is left is written anew."""


class RejoinedAsk(SwitchAsk, eq=False):
    """An ask from before the root's restart. Its asker's home may not be open yet."""

    homes: Any = None

    @property
    def codec(self) -> Codec:
        codec: Codec = self.homes.node.codec
        return codec

    def give(self, answer: Answer, batch: Batch | None = None) -> None:
        """Hand over the outcome, once."""
        homes: Homes = self.homes
        switch = homes.at(self.asker)
        homes.rejoin.forget(self)
        if switch is not None:
            self.switch = switch
            if self.turn <= switch.ledger.turn or (self.turn, self.k) in switch.ledger.outcomes:
                self.is_over, self.future = True, OVER  # That turn has had another outcome, and does not wait.
            else:
                super().give(answer, batch)
        elif not self.is_over:
            self.is_over, self.future = True, OVER
            own = batch if batch is not None else Batch()
            if homes.far.is_far(self.asker):
                if batch is None and homes.far.is_closing:
                    return  # Its receiver has been stopped with the system: it asks whoever leads next.
                homes.far.answered(FarId(self.asker, self.turn, self.k), answer, own)
            else:
                own.add(self.asker, outcome_entry(self.turn, self.k, answer), [])
            if batch is None:
                own.commit(homes.journal)


class FarId(NamedTuple):
    """How an ask is known that another system has sent: no other ask has the name, in any run of that system.

    Attributes:
        asker: the address of who has asked.
        number: that its program has given the ask.
        run: the number of that run of the program; LASTING if the ask outlives it, being recorded itself.
    """

    asker: str
    number: int
    run: int


LASTING: Final = 0
"""The run of an ask that a recorded actor has made: each run of its program asks it under the same number."""


def lasting_number(origin: str) -> int:
    """The number of what a recorded actor sends another system, by its name in the journal here."""
    return int.from_bytes(blake2b(origin.encode(), digest_size=8).digest(), "big") >> 1


class FarOut(msgspec.Struct, array_like=True, frozen=True):
    """A message of a recorded actor to another system, kept until that has accepted it."""

    origin: str
    to: str
    name: str
    body: bytes
    sender: str


class FarSender(Protocol):
    """Whoever sends to other systems, now or when they can be reached."""

    def ask(self, ask: SwitchAsk, *, again: bool) -> None:
        """Send an ask of a recorded actor."""
        ...

    def tell(self, out: FarOut, *, again: bool) -> None:
        """Send a message of a recorded actor; `FarMail.accepted` is called when the other system has it."""
        ...


class FarAnswer(msgspec.Struct, array_like=True, frozen=True):
    """The outcome of such an ask, as it is kept."""

    asker: str
    number: int
    run: int
    kind: str
    name: str
    body: bytes


class FarMail:
    """What recorded actors are asked by other systems, and what they tell those: once, whoever leads the systems.

    The journal of the receiver has an ask as an input; its outcome is kept in the append that ends its turn, until the
    other system is known to have it. An ask that comes again is one of the two, or has never been accepted. A message
    to another system is kept in the append that ends the turn, until that system has accepted it as if it were an ask.

    Attributes:
        deliver: is told each outcome when it is safe.
        sender: sends to other systems; none before there are lines.
        is_closing: whether this system ends: asks that are not answered any more wait for whoever leads it next.
    """

    def __init__(self, homes: Homes) -> None:
        self._homes = homes
        self._answers: dict[FarId, FarAnswer] = {}
        self._open: dict[FarId, float] = {}
        self._outs: dict[str, FarOut] = {}
        self._systems = {key.removeprefix(SYSTEM) for key in homes.journal.notes(SYSTEM)}
        self._positions: list[int] = []
        self._opening: dict[str, list[Callable[[], None]]] = {}
        self.sender: FarSender | None = None
        self.is_closing = False
        self.deliver: Callable[[FarId, Answer], None] = lambda which, answer: None
        saved = homes.journal.load(FAR)
        if saved.snapshot is not None:
            answers, outs = msgspec.msgpack.decode(saved.snapshot, type=tuple[list[FarAnswer], list[FarOut]])
            self._answers.update((_id(one), one) for one in answers)
            self._outs.update((out.origin, out) for out in outs)
        for position, entry in saved.entries:
            self._positions.append(position)
            self._read(position, entry)
        self._turn = saved.turn

    def _read(self, position: int, entry: tuple[Any, ...]) -> None:
        match entry:
            case ("answered", *fields):
                one = FarAnswer(*fields)
                self._answers[_id(one)] = one
            case ("settled", asker, number, run):
                self._answers.pop(FarId(asker, number, run), None)
            case ("out", *fields):
                out = FarOut(*fields)
                self._outs[out.origin] = out
            case ("accepted", origin):
                self._outs.pop(origin, None)
            case _:
                raise HoldfastError(f"other systems: entry {position} is of an unknown kind {entry[0]!r}")

    def is_far(self, path: str) -> bool:
        """Whether an address is another system's."""
        top = f"/{self._homes.node.name}"
        return path != top and not path.startswith(f"{top}/")

    def connected(self, system: str) -> None:
        """There is a line to a system: what recorded actors send it from now on is kept until it has it."""
        if system not in self._systems and not f"/{system}".startswith(PASSING):
            self._systems.add(system)
            self._homes.journal.note(f"{SYSTEM}{system}", b"")

    def _lasts(self, path: str) -> bool:
        """Whether an address is that of a system that there has been a line to, in this run or an earlier one."""
        return path[1:].partition("/")[0] in self._systems

    def begin(self, which: FarId, until: float) -> None:
        """It is on its way to its receiver, and nobody waits for it after `until`, on the monotonic clock."""
        self._open[which] = until
        if len(self._open) % TIDIED == 0:  # Those that have run out in a mailbox have no outcome.
            now = monotonic()
            self._open = {one: until for one, until in self._open.items() if until > now}

    def is_open(self, which: FarId) -> bool:
        """Whether its outcome will come: the receiver has it."""
        return which in self._open or self._homes.rejoin.has(*which)

    def goes_on(self, ask: Ask | None) -> bool:
        """Whether an ask is not to end with this program: another system waits, and the next program answers it."""
        return self.is_closing and isinstance(ask, SwitchAsk) and self.is_far(ask.asker)

    def outcome(self, which: FarId) -> Answer | None:
        """The outcome, if it is known."""
        one = self._answers.get(which)
        return None if one is None else Answer(one.kind, one.name, one.body)

    def answered(self, which: FarId, answer: Answer, batch: Batch) -> None:
        """It has its outcome, which is safe behind the batch."""
        self._open.pop(which, None)
        one = FarAnswer(*which, answer.kind, answer.name, bytes(answer.body))

        def safe() -> None:
            self._answers[which] = one
            self.deliver(which, answer)
            self._tidy()

        if self._homes.journal.durable:
            batch.add(FAR, ("answered", *msgspec.structs.astuple(one)), self._positions)
        batch.after.append(safe)

    def settled(self, which: FarId) -> None:
        """Whoever has asked has the outcome, or does not want it any more."""
        if self._answers.pop(which, None) is not None and which.run == LASTING and self._homes.journal.durable:
            batch = Batch()
            batch.add(FAR, ("settled", *which), self._positions)
            batch.commit(self._homes.journal)

    def forget_run(self, system: str, run: int) -> None:
        """A run of another program is over: what it has asked, and not by a recorded actor, it does not ask again."""
        for which in [one for one in self._answers if one.run == run and one.asker[1:].partition("/")[0] == system]:
            del self._answers[which]

    # -- what is told to other systems ------------------------------------------------------------------------------

    def keeps(self, origin: str, out: Out, sender: str, batch: Batch) -> bool:
        """Keep what a turn tells an actor of another system that lasts, and send it when that is safe."""
        if self.sender is None or not self._lasts(out.to):
            return False
        kept = self._outs[origin] = FarOut(origin, out.to, out.name, bytes(out.body), sender)
        if self._homes.journal.durable:
            batch.add(FAR, ("out", *msgspec.structs.astuple(kept)), self._positions)
        send = self.sender.tell
        batch.after.append(lambda: send(kept, again=False))
        return True

    def accepted(self, origin: str, then: Callable[[], None]) -> None:
        """Another system has a message, or has refused it: it is not sent again. `then` is called when that is safe."""
        if self._outs.pop(origin, None) is None:
            return
        batch = Batch()
        if self._homes.journal.durable:
            batch.add(FAR, ("accepted", origin), self._positions)
        batch.after += (then, self._tidy)
        batch.commit(self._homes.journal)

    def asks_again(self, home: Switch, turn: int, key: int, out: Out) -> bool:
        """A turn asks another system what it asked before the restart: under the same name, so its outcome is one."""
        if self.sender is None or not self._lasts(out.to):
            return False
        source = home.ledger.open.get(key)
        chain = ((home.path, key), *(source.chain if source is not None else ()))
        ask = SwitchAsk.made(home, turn, out, chain, home.node.cell_at(out.to))
        home.calls.asks[turn, out.k] = ask
        home.node.deadlines.add(ask)
        self.sender.ask(ask, again=True)
        return True

    def outs(self, system: str) -> list[FarOut]:
        """What is kept for a system, oldest first."""
        return [out for out in self._outs.values() if out.to.startswith(f"/{system}/")]

    def when_opened(self, path: str, then: Callable[[], None]) -> None:
        """Have something done when the home of a recorded address that nobody was started at yet is open."""
        self._opening.setdefault(path, []).append(then)

    def opened(self, path: str) -> None:
        """A home is open: what it has is known."""
        for then in self._opening.pop(path, ()):
            self._homes.node.loop.call_soon(then)  # When its next life has a place there.

    def _tidy(self) -> None:
        """Write what is left anew when much has come and gone."""
        if len(self._positions) < MOST_ENTRIES:
            return
        journal = self._homes.journal
        left = msgspec.msgpack.encode((list(self._answers.values()), list(self._outs.values())))
        try:
            journal.barrier()
            journal.cut(FAR, left, self._positions, turn=self._turn + 1, keep=1)
        except HoldfastError:
            return  # It stays as long as it is, and is tried again.
        self._turn += 1
        self._positions.clear()


def _id(one: FarAnswer) -> FarId:
    return FarId(one.asker, one.number, one.run)


class KeptMessage(NamedTuple):
    """A message for an address whose home is not open yet; `positions`: where in the journal it stands."""

    name: str
    body: bytes
    sender: str
    positions: list[int]


class Rejoin:
    """All asks of a root that were under way when the one before it ended."""

    def __init__(self, homes: Homes) -> None:
        self._homes = homes
        self._asks: dict[tuple[str, int, int], RejoinedAsk] = {}
        self._kept: dict[str, dict[str, KeptMessage]] = {}  # by address, and by who has told it in which output

    def keep(self, home: Switch, origin: str, out: Out, sender: str, batch: Batch) -> bool:
        """Keep what a turn of `home` tells to an address that this program has not opened yet; False if it has."""
        if not self._homes.is_unopened(out.to):
            return False
        kept = self.kept_for(out.to)[origin] = KeptMessage(out.name, out.body, sender, [])
        shape = home.shapes.now(out.name) if home.journal.durable else None
        if shape is not None:  # Its journal may have the table of an older program.
            batch.add(out.to, shape_entry(out.name, shape), [])
        if home.journal.durable:
            batch.add(out.to, ("kept", origin, *kept[:3]), kept.positions)
        return True

    def read(self, home: Switch, position: int, origin: str, name: str, body: bytes, sender: str) -> None:
        """Take a message that was kept up again, from the journal of its receiver."""
        self.kept_for(home.path).setdefault(origin, KeptMessage(name, body, sender, [])).positions.append(position)

    def kept_for(self, path: str) -> dict[str, KeptMessage]:
        """What is kept for an address, by origin."""
        return self._kept.setdefault(path, {})

    def _hand_over(self, home: Switch) -> None:
        """What was kept for an address becomes inputs, each once: the journal may have it as one already."""
        known = {(source.sender, source.origin) for source in home.ledger.handled_and_open()}
        for origin, kept in self._kept.pop(home.path, {}).items():
            home.ledger.drop(kept.positions)
            is_ask = origin.startswith(MARK)
            own = " ".join(origin.split(" ", 2)[:2]) if is_ask else origin
            if (kept.sender, own) not in known:
                source = home.record(MESSAGE, kept.name, kept.body, kept.sender, origin=own)
                if is_ask:
                    self._owed(home, source)
                home.forward(source)

    def loaded(self, home: Switch) -> None:
        """A home was taken up from what is stored: what it owes an answer."""
        for source in home.ledger.open.values():
            if source.kind == MESSAGE and source.origin.startswith(MARK) and source.sender is not None:
                self._owed(home, source)
        for key, (asker, origin) in home.calls.owed.items():
            home.calls.later[key] = self._of(asker, *_numbers(origin))
        home.calls.owed.clear()
        self._hand_over(home)
        self._homes.far.opened(home.path)

    def _owed(self, home: Switch, source: Input) -> None:
        assert source.sender is not None
        ask = self._of(source.sender, *_numbers(source.origin))
        if not ask.is_over:
            source.ask, source.chain = ask, ask.chain
            ask.to, ask.started = home.cell, True

    def _of(self, asker: str, turn: int, k: int) -> RejoinedAsk:
        asker = self._homes.addresses.now(asker)
        ask = self._asks.get((asker, turn, k))
        if ask is None or ask.is_over:
            cell = self._homes.node.cell_at(asker)
            ask = RejoinedAsk(Parcel("", b""), cell, (), 0.0, math.inf, None)
            ask.started = True  # It may have been: only its outcome will tell.
            ask.future, ask.homes, ask.asker, ask.turn, ask.k = ask, self._homes, asker, turn, k
            self._asks[asker, turn, k] = ask
        return ask

    def rename(self, paths: Mapping[str, str]) -> None:
        """Some who have asked have other addresses now."""
        for ask in self._asks.values():
            ask.asker = paths.get(ask.asker, ask.asker)
        self._asks = {(ask.asker, ask.turn, ask.k): ask for ask in self._asks.values()}
        self._kept = {paths.get(path, path): kept for path, kept in self._kept.items()}

    def has(self, asker: str, turn: int, k: int) -> bool:
        """Whether the outcome of an ask from before this program began is still to come."""
        ask = self._asks.get((asker, turn, k))
        return ask is not None and not ask.is_over

    def forget(self, ask: RejoinedAsk) -> None:
        """Wait no longer for an ask that has its outcome."""
        self._asks.pop((ask.asker, ask.turn, ask.k), None)

    def joins(self, home: Switch, turn: int, key: int, out: Out) -> bool:
        """A turn of `home` asks again what it asked before the restart: whether the answer may still come."""
        if self._homes.far.asks_again(home, turn, key, out):
            return True
        ask = self._asks.get((home.path, turn, out.k))
        if ask is None and not self._homes.knows(out.to):
            return False  # Whoever was asked keeps no journal.
        ask = ask or self._of(home.path, turn, out.k)  # Its receiver's home is not open yet.
        source = home.ledger.open.get(key)
        ask.chain = ((home.path, key), *(source.chain if source is not None else ()))
        ask.to, ask.asked = ask.to or home.node.cell_at(out.to), out.name
        ask.timeout = out.seconds
        home.calls.asks[turn, out.k] = ask
        home.node.deadlines.add(ask)
        return True


def origin_kept(home: Switch, turn: int, key: int, out: Out) -> str:
    """How a journal names what was told to an address that is not open: no other output has the name.

    What a hook (without input, `key` is -1) tells has no number of its own.
    """
    return f"kept {home.path}|{turn}.{out.k}" + ("" if key >= 0 else f" {home.node.numbers.next_seed():x}")


def origin_asked(home: Switch, turn: int, out: Out) -> str:
    """The same of what was asked: the origin of the input that it becomes, and who has asked."""
    return f"{MARK}{turn}.{out.k} {home.path}"


def origin_asked_by(ask: SwitchAsk) -> str:
    """The same of an ask that was made."""
    return f"{MARK}{ask.turn}.{ask.k} {ask.asker}"


def _numbers(origin: str) -> tuple[int, int]:
    turn, _, k = origin.removeprefix(MARK).partition(".")
    return int(turn), int(k)
