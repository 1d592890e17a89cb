"""Asks from inside recorded turns: their outcomes are inputs, and are journaled like one."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import msgspec

from ...actors.errors import (
    ActorStopped,
    AskFailed,
    AskTimeout,
    BadMessage,
    BadReply,
    EffectInDoubt,
    HoldfastError,
    type_name,
)
from ...actors.events import EffectRepeated, EffectRetried
from ...actors.kernel.cell import DOWN, Cell, TurnRest
from ...actors.kernel.codec import Parcel
from ...actors.kernel.envelope import NO_DEADLINE, Ask, ReplyHandle
from ...actors.kernel.mailbox import BY_USER
from ...actors.process.wire.peer import RelayedAsk, asked
from ..inputs import Batch, Input
from ..long_waits import LongWaits
from ..protocol import (
    GIVEN_UP,
    MESSAGE,
    REPLY,
    Answer,
    Came,
    GivenUp,
    Out,
    Outcome,
    Perform,
    Performed,
    Retried,
    Stranded,
    came,
    timed,
    untimed,
)
from ..schema import shape_name
from .input_ledger import outcome_entry

if TYPE_CHECKING:
    from ...actors.kernel.codec import Codec
    from .switch import Switch


ACCEPTED = Came(REPLY, "", msgspec.msgpack.encode(None))


SHORT = 0.05
"""Seconds that asks which change nothing wait for an effect: one that is out for longer keeps them waiting no more."""
SUSPECT = 2
"""Deaths in a row in its turn after which the threads of a message's effects run one at a time."""
FORGOTTEN = "the life that has promised the reply has ended, and the handle was in nothing that the next one has"
MARK = "ask "
"""How the origin of an input begins that somebody's recorded turn has asked; the asker is its sender."""


class EndedCall:
    """Stands for the future of an ask that is over."""

    def done(self) -> bool:
        """Whether there is nothing to wait for: there is not."""
        return True


OVER = EndedCall()


class SwitchAsk(RelayedAsk, eq=False):
    """An ask from inside a recorded turn: its outcome is journaled before the turn hears of it.

    To others it is an ask that was relayed: whoever has an encoded outcome hands that over.
    """

    switch: Any = None
    asker: str = ""
    turn: int = 0
    k: int = 0
    asked: str = ""  # the type of the message, if it is known
    since: int = 0  # when the message was admitted whose turn asks, in microseconds; 0: that is not known
    out: Out | None = None
    target: Any = None  # the Cell that was asked at first
    doubt: HoldfastError | None = None  # why nobody knows whether a life that has ended had handled it
    is_stranded: bool = False  # who is to answer has been stopped, and does so in its next life
    settled: Callable[[], None] | None = None  # called when its outcome is safe
    hears: Callable[[BaseException | None], None] | None = None  # called with the error that it ends by, if any

    @classmethod
    def made(cls, switch: Switch, turn: int, out: Out, chain: Any, to: Cell, source: Input | None) -> SwitchAsk:
        """The ask that was output (turn, k), of the turn that handles `source`."""
        ask = cls(Parcel(out.name, out.body), switch.cell, chain, out.seconds, NO_DEADLINE, None, to)
        ask.future, ask.switch, ask.asker, ask.turn, ask.k, ask.asked = ask, switch, switch.path, turn, out.k, out.name
        ask.since, ask.out, ask.target = since(source), out, to
        return ask

    @property
    def codec(self) -> Codec:
        """The codec that encodes its outcome."""
        codec: Codec = self.switch.node.codec
        return codec

    def done(self) -> bool:
        """As a future has it."""
        return self.is_over

    def answer(self, reply: object) -> None:
        if isinstance(reply, ReplyHandle):
            return
        try:
            body = self.codec.encode(reply, self.asker)
        except BadMessage as error:
            self.fail(BadReply(*asked(self), error.problem))
        else:
            self.give(Answer(REPLY, "", body))

    def answer_raw(self, body: bytes) -> None:
        """Hand over an encoded reply."""
        self.give(Answer(REPLY, "", body))

    def fail(self, error: BaseException) -> None:
        if not self.is_over:
            if self._is_asked_again(error):
                return
            if self.doubt is not None and isinstance(error, ActorStopped):
                error = self.doubt
            self.tell_failure(error)
        self.give(Answer(*self.codec.encode_error(error)))

    def fail_raw(self, kind: str, name: str, body: bytes) -> None:
        """Hand over an encoded error."""
        if not self.is_over and self.out is not None:
            error = self.codec.decode_error(kind, name, body, *asked(self))
            if isinstance(error, (ActorStopped, AskFailed)):
                self.fail(error)
                return
        self.give(Answer(kind, name, body))

    def failure(self, answer: Answer) -> BaseException | None:
        """The error that an outcome is, if it is one."""
        if answer.kind == GIVEN_UP:
            return asyncio.CancelledError()
        if answer.kind == REPLY:
            return None
        return self.codec.decode_error(answer.kind, answer.name, answer.body, *asked(self))

    def _is_asked_again(self, error: BaseException) -> bool:
        return self.out is not None and self.switch.homes.rejoin.next_lives.takes(self, error)

    def strand(self) -> None:
        """Who is to answer has been stopped, and does so in its next life: a turn that is told to stop is left then."""
        self.is_stranded = True
        self.tell_stranded()

    def unstrand(self) -> None:
        """Who is to answer is there again."""
        if self.is_stranded:
            self.is_stranded = False
            self.tell_stranded(is_over=True)

    def tell_stranded(self, *, is_over: bool = False) -> None:
        """Tell the life that waits for it, if there is one, that nobody is there to answer, or that somebody is."""
        if self.switch is not None and self.switch.life.port is not None:
            self.switch.life.port.to_life(Stranded(self.turn, self.k, is_over))

    @property
    def has_nobody(self) -> bool:
        """Whether nobody lives at the moment where it is to be answered, and whoever does next answers it."""
        if self.is_stranded or self.out is None:
            return self.is_stranded
        cell: Cell | None = self.switch.node.find(self.out.to)
        return cell is not None and cell.state is DOWN and self.switch.homes.rejoin.next_lives.answers(cell)

    @property
    def is_stuck(self) -> bool:
        """Whether it is answered only by the next life there, or by who is suspended, as far as that is known here."""
        if self.has_nobody or self.out is None:
            return self.has_nobody
        cell: Cell | None = self.switch.node.find(self.out.to)
        is_suspended = cell is not None and cell.more is not None and cell.more.suspended & BY_USER
        return bool(is_suspended) and self.switch.homes.rejoin.next_lives.answers(cell)

    def drop(self) -> None:
        """Another ask stands in the place of this one, or the next program makes it again: it has no outcome here."""
        self.is_over, self.future = True, OVER

    def give(self, answer: Answer, batch: Batch | None = None) -> None:
        """Hand over the outcome, once."""
        if not self.is_over:
            self.is_over = True
            self.future = OVER  # Not itself any more: a cycle would keep the message until the next collection.
            if answer.kind == REPLY:
                answer = Answer(REPLY, self.asked, answer.body)
            self.switch.calls.outcome(self.turn, self.k, answer, batch)


def since(source: Input | None) -> int:
    """When an input was admitted: with that an ask is one, though an actor that is started anew counts from 0 again."""
    return 0 if source is None else int(source.time * 1e6)


def origin_of(ask: SwitchAsk) -> str:
    """How the journal of its receiver names an ask."""
    return f"{MARK}{ask.turn}.{ask.k}.{ask.since}"


def answer_ask(home: Switch, ask: Ask, answer: Answer) -> None:
    """Hand an encoded outcome to whoever asks from outside recorded turns."""
    if isinstance(ask, RelayedAsk):
        if answer.kind == REPLY:
            ask.answer_raw(answer.body)
        else:
            ask.fail_raw(answer.kind, answer.name, answer.body)
        return
    codec = home.node.codec
    if answer.kind != REPLY:
        ask.fail(codec.decode_error(answer.kind, answer.name, answer.body, *asked(ask)))
        return
    try:
        reply = codec.decode_reply(type(ask.message), answer.body)
    except msgspec.DecodeError as error:
        ask.fail(BadReply(home.path, type_name(type(ask.message)), str(error)))
    else:
        ask.answer(reply)


def turned_away(ask: Ask, error: HoldfastError, *, keep_asks: bool) -> bool:
    """Fail an ask whose receiver has ended; False if it waits for the next life there, as a recorded turn may."""
    if keep_asks and isinstance(ask, SwitchAsk):
        ask.strand()
        return False
    ask.fail(error)
    return True


class PendingCalls:
    """What the turns of one home wait for, and what it owes others.

    Attributes:
        asks: asks of its own turns, by (turn, output).
        sends: sends and publications of its own turns whose receivers have no room yet.
        rests: moments and messages that its own turns wait for.
        effects: effects of its turn in hand that are out.
        long: those of them for which asks that change nothing do not wait.
        later: asks of others that are to be answered later, by input.
        owed: the same as read back from the store: asker and origin.
    """

    def __init__(self, home: Switch) -> None:
        self._home = home
        self.asks: dict[tuple[int, int], SwitchAsk] = {}
        self.sends: set[tuple[int, int]] = set()
        self.rests = LongWaits(home)
        self.effects: dict[tuple[int, int], TurnRest] = {}
        self.long: set[tuple[int, int]] = set()
        self._look: asyncio.TimerHandle | None = None
        self.later: dict[int, Ask] = {}
        self.owed: dict[int, tuple[str, str]] = {}

    # -- what is owed -----------------------------------------------------------------------------------------------

    def owe(self, source: Input, turn: int, batch: Batch) -> None:
        """The turn of an input has ended, and its ask will be answered later."""
        if source.ask is None:
            return
        self.later[source.id] = source.ask
        if isinstance(source.ask, SwitchAsk):
            self._home.note(turn, ("later", turn, source.id), batch)

    def debts(self) -> dict[int, tuple[str, str]]:
        """The asks from recorded turns that are to be answered later: asker and origin."""
        asks = ((key, ask) for key, ask in self.later.items() if isinstance(ask, SwitchAsk) and not ask.is_over)
        return {key: (ask.sender.path, origin_of(ask)) for key, ask in asks}

    def renounce(self, error: HoldfastError, *, keep_asks: bool = False) -> None:
        """Nothing that is owed will be answered. `keep_asks`: but to turns of recorded actors, by the next life."""
        for key, ask in list(self.later.items()):
            if turned_away(ask, error, keep_asks=keep_asks):
                del self.later[key]

    def keep_promises(self, kept: list[int] | None) -> None:
        """A life has come up that can answer these later, and no others: who waits for another one hears so."""
        if kept is None:
            return
        for key in self.later.keys() - set(kept):
            self.later.pop(key).fail(AskFailed(self._home.path, FORGOTTEN))

    # -- what is waited for -----------------------------------------------------------------------------------------

    def join(self, turn: int, key: int, out: Out) -> None:
        """An ask or send that was made before the crash: answered from the journal, or when its pending call is."""
        k, home = out.k, self._home
        answer = home.ledger.outcomes.get((turn, k))
        if answer is None and out.verb == "effect":
            self._resume(turn, key, out)
            return
        if answer is None and out.verb in ("sleep", "wait"):
            if turn > home.ledger.turn:  # Else it has ended without waiting for it, and does so again.
                self.rests.begin(turn, key, out)
            return
        if answer is None and out.verb in ("send", "publish"):
            answer = None if (turn, k) in self.sends else ACCEPTED
        elif answer is None and (turn, k) not in self.asks and not home.homes.rejoin.joins(home, turn, key, out):
            # The root itself was restarted meanwhile, and whoever was asked keeps no journal.
            if turn > home.ledger.turn and home.homes.rejoin.next_lives.may_be_asked(home, turn, out):
                home.outputs.ask_again(turn, key, out)
                return
            why = "the program was started again since, and what it had in hand was not recorded"
            answer = came(Answer(*home.node.codec.encode_error(AskTimeout(out.to, out.seconds, None, why))))
        if answer is not None:
            self._tell(turn, k, answer)

    def _resume(self, turn: int, key: int, out: Out) -> None:
        """An effect was out when the last life ended, and nobody knows what became of it."""
        home = self._home
        if turn <= home.ledger.turn:
            return  # Its turn has ended without waiting for it, and does so again.
        if out.name:
            doubt = Answer(*home.node.codec.encode_error(EffectInDoubt(home.path, out.to)))
            self.outcome(turn, out.k, timed(doubt, home.node.clock.wall()), None)
            return
        source = home.ledger.open.get(key)
        home.node.emit(EffectRepeated(home.path, out.to, "" if source is None else source.name))
        self.order(turn, out, is_again=(turn, out.k) not in self.effects or self.effects[turn, out.k].is_again)

    def turn_begun(self) -> float | None:
        """By when the turn in hand had begun, in whichever life, in Unix time; None if nothing says so.

        What it waits for says since when, and what it has waited for, when that came.
        """
        ledger = self._home.ledger
        turn = ledger.turn + 1
        came = (ledger.outcomes.get((turn, k)) for k in range(1, len(ledger.released) + 1))
        when = next((when for answer in came if answer is not None and (when := untimed(answer)[1])), None)
        return min(filter(None, (when, *(rest.since for rest in self.resting()))), default=None)

    def resting(self) -> list[TurnRest]:
        """What the turn in hand waits for that is no other actor's work."""
        ledger = self._home.ledger
        effects = [one for place, one in self.effects.items() if place[0] > ledger.turn]
        return [*self.rests.rests(), *effects]

    def said(self) -> str:
        """What the turn in hand waits for, in words; "" if that is not known."""
        now = self._home.node.clock.wall()
        asked = [f"waits for an answer of {ask.to.path}" for ask in self.asks.values() if ask.to is not None]
        return " and ".join([*(rest.said(now) for rest in self.resting()), *asked])

    @property
    def waits_for_answer(self) -> bool:
        """Whether the turn in hand has asked somebody who has not answered yet."""
        return any(turn > self._home.ledger.turn for turn, _ in self.asks)

    def stranded(self) -> list[int]:
        """Outputs of the turn in hand that are asks of somebody who is stopped or suspended, and answers after that."""
        return [k for (turn, k), ask in self.asks.items() if turn > self._home.ledger.turn and ask.is_stuck]

    def note_unasked(self, ask: SwitchAsk, *, is_so: bool) -> None:
        """Have the next program know that surely nobody has handled an ask, or that from now on somebody may have."""
        ledger, place, batch = self._home.ledger, (ask.turn, ask.k), Batch()
        if ask.turn > ledger.turn and is_so is not (place in ledger.waits.unasked):
            (ledger.waits.unasked.add if is_so else ledger.waits.unasked.discard)(place)
            self._home.note(ask.turn, ("unasked", *place, is_so), batch)
            batch.commit(self._home.journal)

    def strand(self) -> None:
        """The life is to end: the turn in hand does not wait for who is between two lives, or suspended."""
        for (turn, _), ask in list(self.asks.items()):
            if turn > self._home.ledger.turn and ask.is_stuck:
                ask.tell_stranded()
                self._home.homes.rejoin.next_lives.rest(ask)

    def order(self, turn: int, out: Out, *, is_again: bool = False) -> None:
        """Have the present life perform an effect: all that precedes it is safe.

        `is_again`: it was out before, and since when is not known.
        """
        place = turn, out.k
        if place not in self.effects:  # Else it is done again by a later life.
            if self.effects and next(iter(self.effects))[0] != turn:
                self.long.clear()
                self.effects.clear()  # An earlier turn has ended without waiting for them.
            self.effects[place] = TurnRest("effect", out.to, self._home.node.clock.wall(), is_again=is_again)
        elif self.effects[place].failed:
            self.effects[place] = TurnRest("effect", out.to, self.effects[place].since, is_again=is_again)
        if self._home.life.port is not None:
            self._home.life.port.to_life(Perform(turn, out.k, self._home.life.token, self._is_suspect()))
        self.long.discard(place)
        if self._look is None:
            self._look = self._home.node.loop.call_later(SHORT, self._look_whether_long, place)

    def _is_suspect(self) -> bool:
        """Whether deaths in the turn of the message in hand may be another one's: the next is to show whose."""
        source = self._home.ledger.open.get(self._home.ledger.begun)
        return source is not None and source.deliveries >= max(1, min(SUSPECT, self._home.method.max_deliveries - 1))

    def _look_whether_long(self, place: tuple[int, int]) -> None:
        """See whether an effect has been out for so long that asks which change nothing are answered beside it."""
        self._look = None
        if place in self.effects:
            self.long.add(place)
            self.rests.show(self._home.ledger.open.values())
        elif self.effects:
            self._look = self._home.node.loop.call_later(SHORT, self._look_whether_long, next(iter(self.effects)))

    def performed(self, record: Performed) -> None:
        """An effect of the turn in hand has come to something; what it comes to later, or once more, is of no use."""
        place, ledger = (record.turn, record.k), self._home.ledger
        is_out = ledger.turn < record.turn and ledger.digest_of(*place) and place not in ledger.outcomes
        if is_out and place not in self.asks:
            self.outcome(*place, timed(record.answer, self._home.node.clock.wall()), None)

    def retried(self, record: Retried) -> None:
        """An attempt of an effect of the turn in hand has failed, and is followed by another one."""
        place, home = (record.turn, record.k), self._home
        if place in self.effects:
            rest = self.effects[place]
            self.effects[place] = rest.after(record.attempt, home.node.clock.wall())
            home.node.emit(EffectRetried(home.path, rest.name, *record.attempt))

    def give_up(self, record: GivenUp) -> None:
        """The turn in hand does not want any more what it waits for: no later life of it gets that either.

        A message that had been taken for it by then waits again, behind the others.
        """
        home, place = self._home, (record.turn, record.k)
        if record.turn <= home.ledger.turn or not home.ledger.digest_of(*place):
            return  # It was handled again, and says so again; or it has not let that out.
        known = home.ledger.outcomes.get(place)
        self.rests.withdraw(place)
        if known is None:
            self.outcome(*place, Answer(GIVEN_UP), None)
            return
        taken, _ = untimed(known)
        if taken.kind == MESSAGE:
            batch, source = Batch(), self.rests.taken.pop(place, None)
            self.outcome(*place, Answer(GIVEN_UP), batch)
            again = home.record(MESSAGE, taken.name, taken.body, None if source is None else source.sender, batch)
            again.chain = () if source is None else source.chain
            batch.after.append(lambda: home.admitted(again))
            batch.commit(home.journal)

    def outcome(self, turn: int, k: int, answer: Answer, batch: Batch | None) -> None:
        """An output of ours has an outcome: journal it, and tell the turn that waits.

        The turn goes on before that is safe: what it lets out is journaled behind it, and leaves when both are. If a
        `batch` holds more than the outcome, the turn is told when that is safe.
        """
        own = batch if batch is not None else Batch()
        ask = self.asks.pop((turn, k), None)
        self.effects.pop((turn, k), None)
        self.long.discard((turn, k))
        kept = self._home.ledger.note_outcome(turn, k, answer)
        if kept is not None:
            if self._home.journal.durable:
                self._home.note_shape(shape_name(answer), own)
            self._home.note(turn, outcome_entry(turn, k, kept), own)
        if ask is not None and ask.hears is not None:
            ask.hears(ask.failure(answer))
        told = came(answer) if kept is None else kept
        if batch is not None:
            own.after.append(lambda: self._tell(turn, k, told))
        if ask is not None and ask.settled is not None:
            own.after.append(ask.settled)
        if batch is None:
            own.commit(self._home.journal, is_patient=True)
            self._tell(turn, k, told)

    def abandon(self) -> None:
        """What is still out concerns nobody any more."""
        for ask in self.asks.values():
            ask.is_over, ask.future = True, OVER
            if ask.hears is not None:
                ask.hears(asyncio.CancelledError())
        self.asks.clear()
        self.effects.clear()
        self.long.clear()
        if self._look is not None:
            self._look.cancel()
            self._look = None
        self.sends.clear()
        self.rests.abandon()

    def sent(self, turn: int, k: int, error: HoldfastError | None) -> None:
        """A `send` or `publish` of ours was accepted, or not.

        (The former is not journaled: under replay it is accepted unless it still waits.)
        """
        self.sends.discard((turn, k))
        if error is None:
            self._tell(turn, k, ACCEPTED)
        else:
            self.outcome(turn, k, Answer(*self._home.node.codec.encode_error(error)), None)

    def _tell(self, turn: int, k: int, answer: Came) -> None:
        if self._home.life.port is not None:
            self._home.life.told += 1
            source = self.rests.taken.get((turn, k))  # Whoever leads now may have been given that by the last one.
            taken = -1 if source is None else source.id
            self._home.life.port.to_life(Outcome(turn, k, answer, taken, self._home.ledger.digest_of(turn, k)))
