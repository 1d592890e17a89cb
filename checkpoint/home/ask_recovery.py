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
import sys
from hashlib import blake2b
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

import msgspec

from ...actors.errors import HoldfastError
from ...actors.events import KeptForSystem
from ...actors.kernel.codec import Parcel
from ...actors.kernel.envelope import Ask
from ..inputs import Batch, Input
from ..protocol import AT_ITS_END, MESSAGE, Answer, Out, came
from ..schema import shape_entry
from .input_ledger import outcome_entry
from .next_lives import NextLives, RuntimeAsks
from .pending_asks import MARK, OVER, SwitchAsk, origin_of, since

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
MOST_GONE: Final = 10_000
"""Outcomes that are kept for programs that are no systems and have left, all of them together."""
MOST_GONE_BYTES: Final = 64 << 20
"""The same in bytes."""
MOST_FORGOTTEN: Final = 100_000
"""Runs of programs of which it is known that their outcomes were given up."""
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
            ledger = switch.ledger
            is_another = self.since and self.since != since(ledger.open.get(ledger.begun))
            if is_another or self.turn <= ledger.turn or (self.turn, self.k) in ledger.outcomes:
                # That turn has had another outcome, and does not wait; or who has asked was removed.
                self.is_over, self.future = True, OVER
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
                own.add(self.asker, outcome_entry(self.turn, self.k, came(answer, AT_ITS_END)), [])
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


class KeptLimits(Protocol):
    """How much is kept for one system until it has accepted it."""

    @property
    def kept(self) -> int:
        """How many messages at most."""
        ...

    @property
    def kept_bytes(self) -> int:
        """How many bytes they may have together."""
        ...


class _NoLimits:
    """Of a program without lines, which keeps nothing more."""

    kept = kept_bytes = sys.maxsize


NO_LIMITS: Final = _NoLimits()


class KeptMail:
    """What is kept for one other program: outcomes of what it has asked, and messages of recorded actors.

    Attributes:
        is_system: whether it is known for good, as a system is that there has been a line to.
        answers: by the names of the asks.
        outs: messages that it has not accepted yet, by what sent them, oldest first.
        unsafe: those of them whose turns are not safe yet: nobody is sent them.
        size: of these messages, in bytes.
        told: how full that was when it was last told: not at all, half, or at its limit.
    """

    __slots__ = ("answers", "is_system", "outs", "size", "told", "unsafe")

    def __init__(self) -> None:
        self.is_system = False
        self.answers: dict[FarId, FarAnswer] = {}
        self.outs: dict[str, FarOut] = {}
        self.unsafe: set[str] = set()
        self.size = self.told = 0

    def add(self, out: FarOut) -> None:
        """Keep a message until it is accepted."""
        self.outs[out.origin] = out
        self.size += len(out.body)

    def take(self, origin: str) -> bool:
        """Whether this message is kept here: then it is no more."""
        out = self.outs.pop(origin, None)
        if out is None:
            return False
        self.size -= len(out.body)
        if not self.outs:
            self.told = 0
        return True

    def clear(self) -> None:
        """Keep nothing more."""
        self.answers.clear()
        self.outs.clear()
        self.unsafe.clear()
        self.size = self.told = 0


class FarKept(msgspec.Struct, array_like=True):
    """All that is kept for other programs, as one value.

    Attributes:
        answers: outcomes that they are not known to have.
        outs: messages that they have not accepted.
        forgotten: runs of programs whose outcomes were given up.
    """

    answers: list[FarAnswer]
    outs: list[FarOut]
    forgotten: list[int] = msgspec.field(default_factory=list)


class FarMail:
    """What recorded actors are asked by other systems, and what they tell those: once, whoever leads the systems.

    The journal of the receiver has an ask as an input; its outcome is kept in the append that ends its turn, until the
    other system is known to have it. An ask that comes again is one of the two, or has never been accepted. A message
    to another system is kept in the append that ends the turn, until that system has accepted it as if it were an ask.

    Attributes:
        deliver: is told each outcome when it is safe.
        sender: sends to other systems; none before there are lines.
        limits: how much is kept for one system.
        is_closing: whether this system ends: asks that are not answered any more wait for whoever leads it next.
    """

    def __init__(self, homes: Homes) -> None:
        self._homes = homes
        self._open: dict[FarId, float] = {}
        self._gone: dict[str, None] = {}  # programs that are no systems and have left, longest ago first
        self._forgotten: dict[int, None] = {}  # runs of those whose outcomes were given up, longest ago first
        self._mail: dict[str, KeptMail] = {}
        for key in homes.journal.notes(SYSTEM):
            self._of(f"/{key.removeprefix(SYSTEM)}").is_system = True
        self._positions: list[int] = []
        self._opening: dict[str, list[Callable[[], None]]] = {}
        self.sender: FarSender | None = None
        self.limits: KeptLimits = NO_LIMITS
        self.is_closing = False
        self.deliver: Callable[[FarId, Answer], None] = lambda which, answer: None
        saved = homes.journal.load(FAR)
        if saved.snapshot is not None:
            kept = msgspec.msgpack.decode(saved.snapshot, type=FarKept)
            for one in kept.answers:
                self._of(one.asker).answers[_id(one)] = one
            for out in kept.outs:
                self._of(out.to).add(out)
            self._forgotten.update(dict.fromkeys(kept.forgotten))
        for position, entry in saved.entries:
            self._positions.append(position)
            self._read(position, entry)
        self._turn = saved.turn
        for system, mail in self._mail.items():
            if not mail.is_system:
                self._gone[system] = None

    def _read(self, position: int, entry: tuple[Any, ...]) -> None:
        match entry:
            case ("answered", *fields):
                one = FarAnswer(*fields)
                self._of(one.asker).answers[_id(one)] = one
            case ("settled", asker, number, run):
                self._of(asker).answers.pop(FarId(asker, number, run), None)
            case ("out", *fields):
                out = FarOut(*fields)
                self._of(out.to).add(out)
            case ("accepted", origin):
                any(mail.take(origin) for mail in self._mail.values())
            case ("forgotten", system, run):
                self._give_up(system, run)
            case ("dropped", system):
                self._of(f"/{system}").clear()
            case _:
                raise HoldfastError(f"other systems: entry {position} is of an unknown kind {entry[0]!r}")

    def _of(self, path: str) -> KeptMail:
        """What is kept for the system of an address."""
        system = _system(path)
        found = self._mail.get(system)
        if found is None:
            found = self._mail[system] = KeptMail()
        return found

    def is_far(self, path: str) -> bool:
        """Whether an address is another system's."""
        top = f"/{self._homes.node.name}"
        return path != top and not path.startswith(f"{top}/")

    def connected(self, system: str) -> None:
        """There is a line to a system: what recorded actors send it from now on is kept until it has it."""
        if not f"/{system}".startswith(PASSING) and not self._lasts(f"/{system}"):
            self._of(f"/{system}").is_system = True
            self._homes.journal.note(f"{SYSTEM}{system}", b"")

    def may_know(self, system: str, most: int) -> bool:
        """Whether a program may be taken note of: for good if it is a system, so of those there are so many at most."""
        if f"/{system}".startswith(PASSING) or self._lasts(f"/{system}"):
            return True
        return sum(mail.is_system for mail in self._mail.values()) < most

    def _lasts(self, path: str) -> bool:
        """Whether an address is that of a system that there has been a line to, in this run or an earlier one."""
        mail = self._mail.get(_system(path))
        return mail is not None and mail.is_system

    def begin(self, which: FarId, until: float) -> None:
        """It is on its way to its receiver, and nobody waits for it after `until`, on the machine's clock."""
        self._open[which] = until
        if len(self._open) % TIDIED == 0:  # Those that have run out in a mailbox have no outcome.
            now = self._homes.node.clock.machine()
            self._open = {one: until for one, until in self._open.items() if until > now}

    def is_open(self, which: FarId) -> bool:
        """Whether its outcome will come: the receiver has it, or it waits to be safe."""
        return which in self._open or self._homes.rejoin.has(*which)

    def goes_on(self, ask: Ask | None) -> bool:
        """Whether an ask is not to end with this program: another system waits, and the next program answers it."""
        return self.is_closing and isinstance(ask, SwitchAsk) and self.is_far(ask.asker)

    def outcome(self, which: FarId) -> Answer | None:
        """The outcome, if it is known."""
        mail = self._mail.get(_system(which.asker))
        one = None if mail is None else mail.answers.get(which)
        return None if one is None else Answer(one.kind, one.name, one.body)

    def answered(self, which: FarId, answer: Answer, batch: Batch) -> None:
        """It has its outcome, which is safe behind the batch: until then it is not done again if it comes again."""
        self._open[which] = math.inf
        one = FarAnswer(*which, answer.kind, answer.name, bytes(answer.body))
        place: list[int] = []  # What is written anew has it only when it is safe: until then its entry stays.

        def safe() -> None:
            self._open.pop(which, None)
            self._of(which.asker).answers[which] = one
            self._positions += place
            self.deliver(which, answer)
            self._tidy()

        if self._homes.journal.durable:
            batch.add(FAR, ("answered", *msgspec.structs.astuple(one)), place)
        batch.after.append(safe)

    def settled(self, which: FarId) -> None:
        """Whoever has asked has the outcome, or does not want it any more."""
        mail = self._mail.get(_system(which.asker))
        was_kept = mail is not None and mail.answers.pop(which, None) is not None
        if was_kept and which.run == LASTING and self._homes.journal.durable:
            batch = Batch()
            batch.add(FAR, ("settled", *which), self._positions)
            batch.commit(self._homes.journal)

    def forget_run(self, system: str, run: int) -> None:
        """A run of another program is over: what it has asked, and not by a recorded actor, it does not ask again."""
        mail = self._mail.get(system)
        if mail is not None:
            mail.answers = {which: one for which, one in mail.answers.items() if which.run != run}
            if not mail.is_system and not mail.answers:
                del self._mail[system]
                self._gone.pop(system, None)

    def connects(self, system: str) -> None:
        """There is a line to a program."""
        self._gone.pop(system, None)

    def leaves(self, system: str) -> None:
        """There is no line to a program any more; its outcomes wait for it, but not for ever if many others do."""
        mail = self._mail.get(system)
        if mail is None or mail.is_system:
            return
        self._gone[system] = None
        answers = [one for name in self._gone for one in self._mail[name].answers.values()]
        left, size = len(answers), sum(len(one.body) for one in answers)
        while left > MOST_GONE or size > MOST_GONE_BYTES:
            longest = next(iter(self._gone))
            for one in list(self._mail[longest].answers.values()):
                left, size = left - 1, size - len(one.body)
                if one.run not in self._forgotten:
                    self._note_forgotten(longest, one.run)
            self._give_up(longest, None)

    def _note_forgotten(self, system: str, run: int) -> None:
        if self._homes.journal.durable:
            batch = Batch()
            batch.add(FAR, ("forgotten", system, run), self._positions)
            batch.commit(self._homes.journal)
        self._forgotten[run] = None
        if len(self._forgotten) > MOST_FORGOTTEN:
            del self._forgotten[next(iter(self._forgotten))]

    def _give_up(self, system: str, run: int | None) -> None:
        """Forget the outcomes of a program that has left; `run`: the store says so of this run."""
        if run is not None:
            self._forgotten[run] = None
        self._mail.pop(system, None)
        self._gone.pop(system, None)

    def has_forgotten(self, which: FarId) -> bool:
        """Whether the outcomes of the run that has asked were given up: nobody knows whether this was done."""
        return which.run in self._forgotten

    def keeps_answers(self, system: str, count: int) -> bool:
        """Whether so many outcomes are kept for recorded actors of a system, which do not say that they have them."""
        mail = self._mail.get(system)
        if mail is None or len(mail.answers) < count:  # They are looked at one by one only if they may be so many.
            return False
        return sum(which.run == LASTING for which in mail.answers) >= count

    # -- what is told to other systems ------------------------------------------------------------------------------

    def lasts(self, path: str) -> bool:
        """Whether what a turn tells, or asks, an actor at this address goes to another system that lasts."""
        return self.sender is not None and self._lasts(path)

    def keep(self, origin: str, out: Out, sender: str, batch: Batch) -> None:
        """Keep what a turn tells an actor of another system, and send it when that is safe."""
        kept = FarOut(origin, out.to, out.name, bytes(out.body), sender)
        mail, system = self._of(out.to), _system(out.to)
        node, limits = self._homes.node, self.limits
        if len(mail.outs) >= limits.kept or mail.size + len(kept.body) > limits.kept_bytes:
            problem = f"{len(mail.outs)} messages ({mail.size} bytes) are kept for /{system} already"
            node.dead_letter(node.cell_at(out.to), Parcel(out.name, kept.body), problem, node.cell_at(sender))
            self._tell_kept(system, mail, 2)
            return
        mail.add(kept)
        mail.unsafe.add(origin)
        if 2 * len(mail.outs) >= limits.kept or 2 * mail.size >= limits.kept_bytes:
            self._tell_kept(system, mail, 1)
        if self._homes.journal.durable:
            batch.add(FAR, ("out", *msgspec.structs.astuple(kept)), self._positions)
        batch.after.append(lambda: self._send(mail, kept))

    def _send(self, mail: KeptMail, out: FarOut) -> None:
        """Send a message whose turn is safe now, unless it was dropped meanwhile."""
        mail.unsafe.discard(out.origin)
        if self.sender is not None and out.origin in mail.outs:
            self.sender.tell(out, again=False)

    def _tell_kept(self, system: str, mail: KeptMail, level: int) -> None:
        """Tell, once, how much is kept for a system: from half of the limit on (1), and at the limit (2)."""
        if mail.told < level:
            mail.told = level
            self._homes.node.emit(KeptForSystem(f"/{system}", len(mail.outs), mail.size, level == 2))

    def kept(self) -> dict[str, tuple[int, int]]:
        """How many messages of recorded actors are kept for each system, and their bytes; none for most."""
        return {system: (len(mail.outs), mail.size) for system, mail in self._mail.items() if mail.is_system}

    def drop(self, system: str) -> int:
        """Forget a system, and what is kept for it: how many messages that were. It may connect again all the same.

        They are dead letters; recorded actors there that have asked something here may ask it again, and it is done
        again.

        Raises:
            StoreError: the store does not take it.
        """
        mail = self._mail.get(system)
        if mail is None:
            return 0
        outs = list(mail.outs.values())
        mail.clear()
        mail.is_system = False
        if self._homes.journal.durable:
            batch = Batch()
            batch.add(FAR, ("dropped", system), self._positions)
            batch.commit(self._homes.journal)
            self._homes.journal.note(f"{SYSTEM}{system}", None)
        node, problem = self._homes.node, f"what was kept for /{system} was dropped"
        for out in outs:
            node.dead_letter(node.cell_at(out.to), Parcel(out.name, out.body), problem, node.cell_at(out.sender))
        return len(outs)

    def accepted(self, system: str, origin: str, then: Callable[[], None]) -> None:
        """Another system has a message, or has refused it: it is not sent again. `then` is called when that is safe."""
        mail = self._mail.get(system)
        if mail is None or not mail.take(origin):
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
        ask = SwitchAsk.made(home, turn, out, chain, home.node.cell_at(out.to), source)
        home.calls.asks[turn, out.k] = ask
        home.node.deadlines.add(ask)
        self.sender.ask(ask, again=True)
        return True

    def outs(self, system: str) -> list[FarOut]:
        """What is kept for a system and may be sent, oldest first."""
        mail = self._mail.get(system)
        return [] if mail is None else [out for out in mail.outs.values() if out.origin not in mail.unsafe]

    def when_opened(self, path: str, then: Callable[[], None]) -> None:
        """Have something done when the home of a recorded address that nobody was started at yet is open."""
        self._opening.setdefault(path, []).append(then)

    def opened(self, path: str) -> None:
        """A home is open: what it has is known."""
        for then in self._opening.pop(path, ()):
            self._homes.node.loop.call_soon(then)  # When its next life has a place there.

    def forget_gone(self) -> None:
        """Have nothing left in the store of what is not kept any more."""
        if self._positions:
            self._tidy(most=0)

    def _tidy(self, most: int = MOST_ENTRIES) -> None:
        """Write what is left anew when much has come and gone."""
        if len(self._positions) < most:
            return
        journal = self._homes.journal
        mails = self._mail.values()
        answers = [one for mail in mails for one in mail.answers.values()]
        outs = [out for mail in mails for out in mail.outs.values()]
        left = msgspec.msgpack.encode(FarKept(answers, outs, list(self._forgotten)))
        try:
            journal.barrier()
            journal.cut(FAR, left, self._positions, turn=self._turn + 1, keep=1)
        except HoldfastError:
            return  # It stays as long as it is, and is tried again.
        self._turn += 1
        self._positions.clear()


def _system(path: str) -> str:
    """The first part of an address: the program that it is of."""
    return path[1:].partition("/")[0]


def _id(one: FarAnswer) -> FarId:
    return FarId(one.asker, one.number, one.run)


class KeptMessage(NamedTuple):
    """A message for an address whose home is not open yet.

    Attributes:
        name: of its type.
        body: encoded.
        sender: the address that has told it.
        positions: where in the journal it stands.
        is_earlier: whether a program before this one has kept it.
        ask: whose outcome is due for it, if that is known here already.
    """

    name: str
    body: bytes
    sender: str
    positions: list[int]
    is_earlier: bool = False
    ask: SwitchAsk | None = None


class Rejoin:
    """All asks of a root that were under way when the one before it ended.

    Attributes:
        next_lives: of those that keep no journal, and have been asked something.
    """

    def __init__(self, homes: Homes, runtime: RuntimeAsks) -> None:
        self._homes, self.next_lives = homes, NextLives(homes, runtime)
        self._asks: dict[tuple[str, int, int, int], RejoinedAsk] = {}
        self._kept: dict[str, dict[str, KeptMessage]] = {}  # by address, and by who has told it in which output

    def keep(
        self, home: Switch, origin: str, out: Out, sender: str, batch: Batch, ask: SwitchAsk | None = None
    ) -> bool:
        """Keep what a turn of `home` tells to who was not started by this program yet; False if somebody was.

        An ask that it hands on is kept with what is to be said to who asks.
        """
        to = self._homes.addresses.now(out.to)  # A ref may know it by an address that it has left.
        if not self._homes.is_unopened(to):
            return False
        kept = self.kept_for(to)[origin] = KeptMessage(out.name, out.body, sender, [], ask=ask)
        shape = home.shapes.now(out.name) if home.journal.durable else None
        if shape is not None:  # Its journal may have the table of an older program.
            batch.add(to, shape_entry(out.name, shape), [])
        if home.journal.durable:
            batch.add(to, ("kept", origin, *kept[:3]), kept.positions)
        return True

    def read(self, home: Switch, position: int, origin: str, name: str, body: bytes, sender: str) -> None:
        """Take a message that was kept up again, from the journal of its receiver."""
        kept = self.kept_for(home.path).setdefault(origin, KeptMessage(name, body, sender, [], is_earlier=True))
        if position not in kept.positions:  # It stands there already if a start before this one has failed.
            kept.positions.append(position)

    def kept_for(self, path: str) -> dict[str, KeptMessage]:
        """What is kept for an address, by origin."""
        return self._kept.setdefault(path, {})

    def _hand_over(self, home: Switch) -> None:
        """What was kept for an address becomes inputs, oldest first, and each once: the journal may have it as one."""
        known = {(source.sender, source.origin) for source in home.ledger.handled_and_open()}
        messages = self._kept.pop(home.path, {}).items()  # What the journal had was read behind what came since.
        for origin, kept in sorted(messages, key=lambda one: not one[1].is_earlier):
            home.ledger.drop(kept.positions)
            is_ask = origin.startswith(MARK)
            own = " ".join(origin.split(" ", 2)[:2]) if is_ask else origin
            if (kept.sender, own) not in known:
                source = home.record(MESSAGE, kept.name, kept.body, kept.sender, origin=own)
                if is_ask:
                    self._owed(home, source, kept.ask)
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

    def _owed(self, home: Switch, source: Input, ask: SwitchAsk | None = None) -> None:
        assert source.sender is not None
        ask = ask or self._of(source.sender, *_numbers(source.origin))
        if not ask.is_over:
            source.ask, source.chain = ask, ask.chain
            ask.to, ask.started = home.cell, True

    def _of(self, asker: str, turn: int, k: int, when: int) -> RejoinedAsk:
        asker = self._homes.addresses.now(asker)
        ask = self._asks.get((asker, turn, k, when))
        if ask is None or ask.is_over:
            cell = self._homes.node.cell_at(asker)
            ask = RejoinedAsk(Parcel("", b""), cell, (), 0.0, math.inf, None)
            ask.started = True  # It may have been: only its outcome will tell.
            ask.future, ask.homes, ask.asker, ask.turn, ask.k, ask.since = ask, self._homes, asker, turn, k, when
            self._asks[asker, turn, k, when] = ask
        return ask

    def rename(self, paths: Mapping[str, str]) -> None:
        """Some who have asked have other addresses now."""
        for ask in self._asks.values():
            ask.asker = paths.get(ask.asker, ask.asker)
        self._asks = {(ask.asker, ask.turn, ask.k, ask.since): ask for ask in self._asks.values()}
        self._kept = {paths.get(path, path): kept for path, kept in self._kept.items()}

    def has(self, asker: str, turn: int, k: int) -> bool:
        """Whether the outcome of an ask from before this program began is still to come."""
        ask = self._asks.get((asker, turn, k, 0))
        return ask is not None and not ask.is_over

    def forget(self, ask: RejoinedAsk) -> None:
        """Wait no longer for an ask that has its outcome."""
        self._asks.pop((ask.asker, ask.turn, ask.k, ask.since), None)

    def joins(self, home: Switch, turn: int, key: int, out: Out) -> bool:
        """A turn of `home` asks again what it asked before the restart: whether the answer may still come."""
        if self._homes.far.asks_again(home, turn, key, out):
            return True
        source = home.ledger.open.get(key)
        ask = self._asks.get((home.path, turn, out.k, since(source)))
        if ask is None and not self._homes.knows(self._homes.addresses.now(out.to)):
            return False  # Whoever was asked keeps no journal.
        ask = ask or self._of(home.path, turn, out.k, since(source))  # Its receiver's home is not open yet.
        ask.chain = ((home.path, key), *(source.chain if source is not None else ()))
        ask.to, ask.asked = ask.to or home.node.cell_at(out.to), out.name
        ask.timeout = out.seconds
        home.calls.asks[turn, out.k] = ask
        home.node.deadlines.add(ask)
        return True


def origin_kept(home: Switch, turn: int, out: Out) -> str:
    """How a journal names what was told to an address that is not open: no other output has the name.

    A number says too little: what a hook tells has none, and who is removed and started anew counts from the beginning.
    """
    return f"kept {home.path}|{turn}.{out.k} {home.node.numbers.next_seed():x}"


def origin_asked(home: Switch, turn: int, out: Out, source: Input | None) -> str:
    """The same of what was asked: the origin of the input that it becomes, and who has asked."""
    return f"{MARK}{turn}.{out.k}.{since(source)} {home.path}"


def origin_asked_by(ask: SwitchAsk) -> str:
    """The same of an ask that was made."""
    return f"{origin_of(ask)} {ask.asker}"


def _numbers(origin: str) -> tuple[int, int, int]:
    turn, k, *when = map(int, origin.removeprefix(MARK).split("."))
    return turn, k, when[0] if when else 0  # An older program has noted no time.
