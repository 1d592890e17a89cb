"""The ledger of a home: inputs since the newest snapshot, and what came of them. Data and decisions.

Nothing here writes, sends, or reads a clock. The switch journals each change, and `read_entry` makes the same change
from the journal's entry: a ledger that is read back equals the one that was lost.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import msgspec

from ...actors.errors import DIVERGES, RAISED_AGAIN, ReplayDiverged
from ..inputs import NO_DIGESTS, OVERHEAD, Contained, Input, RowPlace, Turn, spread
from ..life.replay_guard import StateDiverged
from ..long_waits import due_entry
from ..protocol import (
    AT_ITS_END,
    DROPPED,
    FAILED,
    LEADS_NOWHERE,
    MESSAGE,
    OK,
    PIPE,
    START,
    STASHED,
    TICK,
    TIMED,
    TOO_LATE,
    Answer,
    Came,
    EndWanted,
    Out,
    TurnEnd,
    came,
)

if TYPE_CHECKING:
    from ..journal import Entry
    from ..snapshot.snapshot_record import Meta


@dataclasses.dataclass(slots=True)
class OwnEnd:
    """The end of an actor by its own `ctx.stop`.

    Attributes:
        wanted: a turn has said so, and the actor's supervisor has not dealt with that yet.
        positions: where in the journal it stands.
        past: the last turn that has said so, and that was dealt with.
    """

    wanted: EndWanted | None = None
    positions: list[int] = dataclasses.field(default_factory=list)
    past: int = -1


@dataclasses.dataclass(slots=True)
class SharedRows:
    """Rows of the journal that several inputs share, or the ends of several turns.

    Attributes:
        ends: where the ends of several turns stand, by the last of them.
        gone: inputs that have ended without a turn since the newest snapshot, each with its row.
        parted: rows of which the newest snapshot contains some inputs, and others not.
        over: the inputs in such rows that it contains.
    """

    ends: dict[int, list[int]] = dataclasses.field(default_factory=dict)
    gone: list[tuple[RowPlace, int]] = dataclasses.field(default_factory=list)
    parted: list[RowPlace] = dataclasses.field(default_factory=list)
    over: frozenset[int] = frozenset()


@dataclasses.dataclass(slots=True)
class LedgerWaits:
    """What the turn in hand at one address has waited for.

    Attributes:
        heard: how many outcomes it has.
        lasts: whether it has had effects or long waits: it goes on in the next life at its address.
        dues: until when outputs of it wait, in Unix time; of one that waits until a moment, or for ever, since when.
        unasked: asks among them that surely nobody has handled: who was to was stopped with the program.
    """

    heard: int = 0
    lasts: bool = False
    dues: dict[tuple[int, int], float] = dataclasses.field(default_factory=dict)
    unasked: set[tuple[int, int]] = dataclasses.field(default_factory=set)

    def end(self) -> None:
        """The turn in hand is over, or is to begin anew with nothing known of it."""
        self.heard, self.lasts = 0, False
        if self.dues:
            self.dues.clear()
        if self.unasked:
            self.unasked.clear()


@dataclasses.dataclass(slots=True)
class InputLedger:
    """The inputs of one address, its turns, and where they stand in the journal.

    Attributes:
        path: the address.
        next_id: the number of the next input.
        open: inputs without an end, in admission order.
        turn: the last ended turn; `on_start` is turn 0.
        turns: the ended turns since the newest snapshot, by number.
        begun: the input of the turn after `turn`, if it has released outputs.
        released: digests of those outputs.
        outcomes: of the asks that these turns have made, by (turn, output).
        waits: what the turn in hand has waited for.
        pipes_done: the background work of these turns that has its result, by turn.
        journal_bytes: what is counted against the journal's limit.
        newest: the snapshot that the next life begins with.
        older: the one before it, if the store does not have it.
        stash: inputs that had been put aside when the newest snapshot was made.
        positions: in the journal, of what belongs to a turn besides its input.
        dropped: the same of what the next snapshot need not be followed by.
        shared: rows of the journal that several inputs or ends share.
        own_end: whether the actor is to end, as a turn has said.
        read: the inputs before this number were there already when this program began.
    """

    path: str
    next_id: int = 0
    open: dict[int, Input] = dataclasses.field(default_factory=dict)
    turn: int = -1
    turns: dict[int, Turn] = dataclasses.field(default_factory=dict)
    begun: int = -1
    released: list[int] = dataclasses.field(default_factory=list)
    outcomes: dict[tuple[int, int], Came] = dataclasses.field(default_factory=dict)
    waits: LedgerWaits = dataclasses.field(default_factory=lambda: LedgerWaits())
    pipes_done: dict[int, set[int]] = dataclasses.field(default_factory=dict)
    journal_bytes: int = 0
    newest: Meta | None = None
    older: Meta | None = None
    stash: list[int] = dataclasses.field(default_factory=list)
    positions: dict[int, list[int]] = dataclasses.field(default_factory=dict)
    dropped: list[list[int]] = dataclasses.field(default_factory=list)
    shared: SharedRows = dataclasses.field(default_factory=lambda: SharedRows())
    own_end: OwnEnd = dataclasses.field(default_factory=lambda: OwnEnd())
    read: int = 0

    # -- what there is ----------------------------------------------------------------------------------------------

    @property
    def has_state(self) -> bool:
        """Whether there is a state to begin with."""
        return self.newest is not None and self.newest.has_state

    @property
    def state_turn(self) -> int:
        """The turn that the next life begins after, apart from what is replayed to it; -1: none."""
        return self.newest.turn if self.newest is not None else -1

    @property
    def is_new(self) -> bool:
        """Whether nothing was ever handled here, or all of it was undone."""
        return self.turn == self.state_turn and not self.has_state

    @property
    def has_sent(self) -> bool:
        """Whether a turn since the newest snapshot has let out anything that leads to an address."""
        return self.is_sending or any(map(leads_somewhere, (turn.digests for turn in self.turns.values())))

    @property
    def is_sending(self) -> bool:
        """Whether the turn in hand has."""
        return leads_somewhere(self.released)

    def stashed(self) -> set[int]:
        """The inputs that the actor has put aside."""
        return {turn.input.id for turn in self.turns.values() if turn.status == STASHED} | set(self.stash)

    def handled_and_open(self) -> Iterator[Input]:
        """The inputs of the turns since the newest snapshot, then those without an end."""
        yield from (turn.input for turn in self.turns.values())
        yield from self.open.values()

    def start(self) -> Input | None:
        """The start of the actor, if it has not ended."""
        return next((source for source in self.open.values() if source.kind == START), None)

    def backlog(self, running: int) -> int:
        """Messages and ticks that wait; `running` is the input in hand, -1 if none."""
        return sum(source.kind in (MESSAGE, TICK) and source.id != running for source in self.open.values())

    def waiting(self) -> list[Input]:
        """What a life that has caught up is fed: the input of the turn that has begun to send, then the others."""
        stashed = self.stashed()
        waiting = [one for one in self.open.values() if one.kind != START and one.id not in stashed and not one.held]
        waiting.sort(key=lambda one: one.id != self.begun)
        return waiting

    def replayed(self, left_out: Collection[int]) -> list[tuple[int, Turn]]:
        """The turns that a new life handles again, in order: failed ones have left nothing behind."""
        return [
            (number, turn)
            for number, turn in self.turns.items()
            if turn.status in (OK, STASHED) and number not in left_out
        ]

    def spent(self) -> list[tuple[int, str]]:
        """The turns that no life handles again though a timer has come in them, each with that."""
        ends = self.turns.items()
        return [
            (at, one.input.origin) for at, one in ends if one.input.kind == TICK and one.status in (FAILED, DROPPED)
        ]

    def ended_in_the_stash(self) -> tuple[int, ...]:
        """Inputs that are put aside under replay, though they have ended since."""
        stashed = (turn.input.id for turn in self.turns.values() if turn.status == STASHED)
        return tuple(key for key in stashed if key not in self.open)

    def is_touched_since(self, digests: set[int]) -> bool:
        """Whether a turn behind the newest snapshot has sent one of these."""
        turns = (turn.digests for number, turn in self.turns.items() if number > self.state_turn)
        return bool(digests) and not all(digests.isdisjoint(known) for known in (*turns, self.released))

    # -- admission --------------------------------------------------------------------------------------------------

    def admit(self, kind: str, name: str, body: bytes, time: float, sender: str | None, origin: str = "") -> Input:
        """Number an input, which is open from now on."""
        key = self.next_id
        self.next_id = key + 1
        source = self.open[key] = Input(key, -1, kind, name, body, time, sender)
        if origin:
            source.origin = origin
        self.journal_bytes += len(body) + OVERHEAD
        return source

    def withdraw(self, source: Input) -> bool:
        """End an input without a turn; False if it has ended already."""
        if self.open.pop(source.id, None) is None:
            return False
        self.journal_bytes -= source.size
        return True

    def admit_result(self, turn: int, k: int) -> bool:
        """Whether the result of background work, output (turn, k), is the first one: only that is an input."""
        done = self.pipes_done.setdefault(turn, set())
        is_first = k not in done
        done.add(k)
        return is_first

    # -- turns ------------------------------------------------------------------------------------------------------

    def compare_outputs(
        self, turn: int, key: int, outs: Sequence[Out], is_as_before: Callable[[Out, int], bool]
    ) -> int:
        """How many of these outputs had left before; the others are taken down as released.

        Args:
            turn: that has sent them.
            key: its input.
            outs: in program order.
            is_as_before: whether an output is the one of a digest, but for what may have changed since.

        Raises:
            ReplayDiverged: they are not what had left.
        """
        is_ended = turn <= self.turn
        if is_ended:
            past = self.turns.get(turn)
            known = past.digests if past is not None else []
        elif self.begun != key:
            if self.released:
                raise ReplayDiverged(self.path, turn, 1)
            self.begun, known = key, self.released
        else:
            known = self.released
        count, again = len(known), 0
        for out in outs:
            if out.k > count:
                if is_ended:
                    raise ReplayDiverged(self.path, turn, out.k, "", said_of(out))
                known.append(out.digest())
            elif known[out.k - 1] != out.digest() and not is_as_before(out, known[out.k - 1]):
                raise ReplayDiverged(self.path, turn, out.k, "", said_of(out))
            else:
                again += 1
        return again

    def end_turn(self, source: Input, number: int, status: str, state: int = 0, reply: int = 0) -> Turn:
        """End a turn, with the outputs that it has released."""
        digests = NO_DIGESTS
        if self.released:
            digests, self.released = self.released, []
        turn = self.turns[number] = Turn(source, status, digests, state, reply)
        self.begun = -1
        self.waits.end()
        self.turn = number
        if source.deliveries:
            source.deliveries = 0
        if status == STASHED:
            source.was_stashed = True
        else:
            del self.open[source.id]
        return turn

    def judge_replay(
        self,
        end: TurnEnd,
        seen: int,
        explain: Callable[[Answer], str],
        is_same_reply: Callable[[Input, int, Answer], bool],
    ) -> None:
        """Compare a turn that was handled again with what it was before; `seen` of its outputs have come again.

        `is_same_reply`: whether the reply to an input is the one of a digest, but for what may have changed since.

        Raises:
            ReplayDiverged: it has ended otherwise.
        """
        number, past = end.turn, self.turns.get(end.turn)
        if end.status == FAILED and past is not None and past.input.kind == START and past.status != FAILED:
            return  # It has not become anything else: its start failed, and will be tried again.
        if past is not None and end.status in (FAILED, DROPPED) and end.status != past.status:
            what = RAISED_AGAIN if end.status == FAILED else "it cannot be handled any more:"
            hint = DIVERGES if end.status == FAILED else "the class has been changed since; what is recorded stays"
            name, error = past.input.name or past.input.kind, explain(end.answer)
            cause = f"{name} was handled well before the crash; {what} {error} ({hint})"
            raise ReplayDiverged(self.path, number, seen + 1, cause)
        if past is None or seen != len(past.digests) or end.status != past.status:
            raise ReplayDiverged(self.path, number, seen + 1)
        if end.state != past.state and end.state and past.state:
            cause = (
                f"after {past.input.name or past.input.kind} its state is not what it was before the crash; use "
                "ctx.now(), ctx.random and ctx.uuid(), and find the cause with hybrid(strict=True)"
            )
            raise StateDiverged(self.path, number, 0, cause)
        if past.reply and not is_same_reply(past.input, past.reply, end.answer):
            cause = f"the reply to {past.input.name} is not what it was before the crash; {DIVERGES}"
            raise ReplayDiverged(self.path, number, seen + 1, cause)

    def judge_begun(self, end: TurnEnd, seen: int, owed: int) -> None:
        """Compare a turn without an end, which an earlier life had begun, with what that has let out.

        Raises:
            ReplayDiverged: it has let out less, and each replay of it would say so.
        """
        if seen < owed and end.status in (OK, STASHED):
            raise ReplayDiverged(self.path, end.turn, seen + 1)

    def digest_of(self, turn: int, k: int) -> int:
        """The digest of what was output (turn, k) before; 0: that is not known any more."""
        past = self.turns.get(turn)
        digests = self.released if turn > self.turn else past.digests if past is not None else []
        return digests[k - 1] if k <= len(digests) else 0

    def note_outcome(self, turn: int, k: int, answer: Answer) -> Came | None:
        """Keep the outcome of what was output (turn, k), with its place among others; None if no replay will want it.

        What takes the place of an outcome (the turn has given it up) has the place of that.
        """
        if turn <= self.state_turn:
            return None
        before = self.outcomes.get((turn, k))
        kept = self._placed(turn, answer) if before is None else came(answer, before.nth, before.after)
        self._take_outcome(turn, k, kept)
        return kept

    def _placed(self, turn: int, answer: Answer) -> Came:
        """What comes now of an output of a turn, behind all that the turn has had."""
        return came(answer, self.waits.heard + 1, len(self.released)) if turn > self.turn else came(answer, TOO_LATE)

    def _take_outcome(self, turn: int, k: int, answer: Came) -> None:
        """A turn that gets further than before has not died of the same thing again: its deaths are counted anew."""
        if turn > self.turn and (turn, k) not in self.outcomes and self.begun in self.open:
            self.open[self.begun].deliveries = 0
        if turn > self.turn:
            self.waits.heard = max(self.waits.heard, answer.nth)
        self.outcomes[turn, k] = answer

    def end_with(self, wanted: EndWanted | None) -> list[int]:
        """The actor is to end, as a turn has said, or (None) that is over; returns where the place in the journal goes.

        The next snapshot does not contain it: only when it is over it need not be read again.
        """
        own = self.own_end
        if wanted is not None:
            own.positions = []
        elif own.wanted is not None:
            own.past = own.wanted.turn
            self.drop(own.positions)
        own.wanted = wanted
        return own.positions

    # -- deaths -----------------------------------------------------------------------------------------------------

    def blamed(self, running: int) -> Input | None:
        """The input that a death in its turn counts against: a start is its supervisor's business."""
        source = self.open.get(running)
        return None if source is None or source.kind == START else source

    def count_death(self, running: int, *, is_ordered: bool, most: int) -> Input | None:
        """Count the death of a life with this input in hand, if it was not ordered.

        Returns:
            The input, if it has died of it so often that it is to be put into quarantine.
        """
        if running in self.open:
            self.open[running].was_cut = True
        source = None if is_ordered else self.blamed(running)
        if source is None:
            return None
        source.deliveries += 1
        return source if source.deliveries >= most else None

    def undo_begun(self) -> Input | None:
        """Let the turn in hand begin anew, unless it has released something: then its input is returned."""
        source = self.open.get(self.begun)
        if source is None or not self.released:
            self.released, self.begun = [], -1
            self.waits.end()
            return None
        return source

    # -- cuts -------------------------------------------------------------------------------------------------------

    def positions_of(self, turn: int) -> list[int]:
        """Where in the journal a turn's own entries stand."""
        return self.positions.setdefault(turn, [])

    def drop(self, *sinks: list[int] | None) -> None:
        """Have the next snapshot cut what stands there, or will stand there when it is written."""
        self.dropped += (sink for sink in sinks if sink is not None)

    def drop_input(self, source: Input) -> None:
        """The same of an input that has ended without a turn."""
        self.drop(source.positions)
        if source.row is not None:
            self.shared.gone.append((source.row, source.id))

    def contained_in(self, turn: int) -> Contained:
        """What a snapshot of the state after `turn` contains: found once, for the cut and for all that follows it."""
        inputs: dict[int, Input] = {}
        for number, past in self.turns.items():
            if number <= turn:
                inputs[past.input.id] = past.input
            else:  # An image may be behind: what was stashed when it was begun may have been handled since.
                inputs.pop(past.input.id, None)
        for key in inputs.keys() & self.open.keys():  # It is only stashed.
            del inputs[key]
        rows: dict[RowPlace, list[int]] = {}
        gone = ((key, row) for row, key in dict.fromkeys(self.shared.gone) if key not in inputs)
        last: RowPlace | None = None
        keys: list[int] = []
        for key, row in itertools.chain(((key, source.row) for key, source in inputs.items()), gone):
            if row is not last:  # Inputs of one row come one after the other, as a rule.
                last = row
                keys = [] if row is None or not row.positions else rows.setdefault(row, [])  # The store has refused it.
            keys.append(key)
        return Contained(turn, list(inputs.values()), rows)

    def needless(self, contained: Contained) -> list[int]:
        """The positions that need not follow such a snapshot."""
        drop = [position for known in self.dropped for position in known]
        own = itertools.chain(self.positions.items(), self.shared.ends.items())
        for number, known in own:  # Those of hooks are there.
            if number <= contained.turn:
                drop += known
        for source in contained.inputs:
            drop += source.positions or ()
        for row, keys in contained.rows.items():
            if row.left == len(keys):
                drop += row.positions
        return drop

    def over_after(self, contained: Contained) -> list[int]:
        """The inputs that such a snapshot contains, though their rows have to follow it."""
        rows = contained.rows
        over = [key for row, keys in rows.items() if row.left > len(keys) for key in (*row.over, *keys)]
        return over + [key for row in self.shared.parted if row not in rows for key in row.over]

    def begin_after(self, meta: Meta) -> None:
        """Begin with a snapshot as the store has it; its entries follow."""
        self.newest, self.stash, self.turn, self.next_id = meta, meta.stash, meta.turn, meta.next_id
        self.shared.over = frozenset(meta.over)

    def read_anew(self, newest: Meta | None, entries: Sequence[tuple[int, Entry]]) -> InputLedger:
        """The same from an older snapshot on, as the store has it; whoever waits for an answer goes on waiting."""
        ledger = InputLedger(self.path)
        if newest is not None:
            ledger.begin_after(newest)
        for position, entry in entries:
            values: tuple[Any, ...] = entry
            if ledger.read_entry(position, values):
                continue
            match values:
                case ("shape", *_):
                    ledger.drop([position])
                case ("tie" | "later" | "replied" | "op", turn, *_):
                    ledger.positions_of(turn).append(position)
                case _:
                    pass  # Whoever keeps it knows where it stands.
        known = {position for sink in ledger.dropped for position in sink}
        ledger.drop(*(sink for sink in self.dropped if known.isdisjoint(sink)))
        ledger.open = {key: self.open.get(key, source) for key, source in ledger.open.items()}
        for turn in ledger.turns.values():
            turn.input = ledger.open.get(turn.input.id, turn.input)
        ledger.next_id, ledger.read = self.next_id, self.read
        return ledger

    def begin_with(self, meta: Meta, contained: Contained) -> None:
        """Have the next life begin with this snapshot, and forget the turns that it contains."""
        shared, turn = self.shared, meta.turn
        for row, keys in contained.rows.items():
            row.left -= len(keys)
            row.over += tuple(keys)
        shared.parted = [row for row in dict.fromkeys((*shared.parted, *contained.rows)) if row.left]
        self.dropped.clear()
        shared.gone.clear()
        self.newest, self.stash = meta, meta.stash
        ended = [past for number, past in self.turns.items() if number <= turn and past.status != STASHED]
        self.journal_bytes -= sum([len(past.input.body) for past in ended]) + OVERHEAD * len(ended)
        self.turns = {number: past for number, past in self.turns.items() if number > turn}
        for known in (self.positions, shared.ends, self.pipes_done):
            for number in [number for number in known if number <= turn]:
                del known[number]
        self._forget_outcomes(key for key in self.outcomes if key[0] <= turn)

    def give_up(self, number: int) -> Turn:
        """Forget an ended turn that nothing will replay. (In a store it stays until the next snapshot.)"""
        turn = self.turns.pop(number)
        source = turn.input
        if not (source.was_stashed and any(past.input is source for past in self.turns.values())):
            self.drop(self.positions.pop(number, None))  # Perhaps they stand nowhere yet.
            if source.id not in self.open:  # Else it was put aside, and waits again.
                self.drop_input(source)
        if turn.status != STASHED:
            self.journal_bytes -= turn.input.size
        self.pipes_done.pop(number, None)
        self._forget_outcomes(key for key in self.outcomes if key[0] == number)
        return turn

    def _forget_outcomes(self, keys: Iterable[tuple[int, int]]) -> None:
        for key in list(keys):
            del self.outcomes[key]

    # -- the journal ------------------------------------------------------------------------------------------------

    def entries(self) -> list[Entry]:
        """All of it behind the newest snapshot, as `read_entry` takes it."""
        inputs = {source.id: source for source in self.handled_and_open()}
        entries = [inputs[key].entry() for key in sorted(inputs)]
        entries += [("late", key) for key, source in self.open.items() if source.is_late]
        heard = sorted(self.outcomes.items())
        entries += [outcome_entry(*place, answer) for place, answer in heard if place[0] <= self.turn]
        entries += [turn.entry(number) for number, turn in self.turns.items()]
        entries += [outcome_entry(*place, answer) for place, answer in heard if place[0] > self.turn]
        if self.released:
            entries.append(self.released_entry(self.turn + 1))
        entries += [due_entry(*place, when) for place, when in self.waits.dues.items()]
        entries += [("unasked", *place, True) for place in self.waits.unasked]
        # What was put aside once may have ended in a turn that was given up.
        ended = {turn.input.id for turn in self.turns.values() if turn.status != STASHED}
        entries += [("drop", key) for key in dict.fromkeys(self.ended_in_the_stash()) if key not in ended]
        return entries if self.own_end.wanted is None else [*entries, stop_entry(self.own_end.wanted)]

    def released_entry(self, turn: int, since: int = 0) -> Entry:
        """What the journal has of a turn that has not ended; `since`: so many of its outputs stand there already."""
        return "out", turn, self.begun, tuple(self.released[since:]), *((since,) if since else ())

    def read_entry(self, position: int, entry: tuple[Any, ...]) -> bool:
        """Take a journal entry up again, in order; False if it is of another kind."""
        match entry:
            case ("in", _, _, _, _, _, _, _, *_) | ("ins", _, _, _, *_):
                place = RowPlace([position])
                for one in spread(entry):
                    self._read_input(place, *one[1:])
                if place.over:
                    self.shared.parted.append(place)
            case ("ends", first, keys):
                self.shared.ends[first + len(keys) - 1] = [position]
                for number, key in enumerate(keys, first):
                    if key in self.open:  # Else the snapshot contains it.
                        self._read_end(self.open[key], number, OK, ())
            case ("end", turn, key, status, digests, *more):
                if key in self.open:
                    self.positions_of(turn).append(position)
                    self._read_end(self.open[key], turn, status, digests, *more)
            case ("out", turn, key, digests, *more):
                self.positions_of(turn).append(position)
                if turn > self.turn:
                    self.released[more[0] if more else 0 :] = digests
                    self.begun = key
            case ("due", turn, k, when):
                self.positions_of(turn).append(position)
                if turn > self.turn:
                    self.waits.dues[turn, k], self.waits.lasts = when, True
            case ("unasked", turn, k, is_so):
                self.positions_of(turn).append(position)
                if turn > self.turn:
                    (self.waits.unasked.add if is_so else self.waits.unasked.discard)((turn, k))
            case ("got", turn, k, kind, name, body, *order):
                self.positions_of(turn).append(position)
                answer = Came(kind, name, body, *order)
                if answer.nth != AT_ITS_END:
                    self._take_outcome(turn, k, answer)
                elif (turn, k) not in self.outcomes:  # Else its time had run out: that is what the turn has seen.
                    self._take_outcome(turn, k, self._placed(turn, answer))
                self.waits.lasts |= turn > self.turn and kind.startswith(TIMED)
            case ("stop", *said):
                self.end_with(EndWanted(*said) if said else None).append(position)
            case ("drop", key):
                self.drop([position])
                if key in self.open:
                    self.drop_input(self.open[key])
                    self.withdraw(self.open[key])
            case ("tried", key, count):
                if key in self.open:
                    self.open[key].deliveries = count
                    source = self.open[key]
                    source.positions = [*(source.positions or ()), position]
            case ("late", key):
                if key in self.open:
                    source = self.open[key]
                    source.is_late, source.positions = True, [*(source.positions or ()), position]
                else:
                    self.drop([position])
            case _:
                return False
        return True

    def _read_input(
        self, row: RowPlace, key: int, kind: str, name: str, body: bytes, when: float, sender: str | None, origin: str,
        *end: Any,
    ) -> None:  # fmt: skip
        if key in self.shared.over:
            row.over += (key,)
            return
        source = self.open[key] = Input(key, -1, kind, name, body, when, sender)
        source.origin, source.row = origin, row
        row.left += 1
        self.next_id = max(self.next_id, key + 1)
        self.journal_bytes += source.size
        if kind == PIPE and origin:
            turn, k = map(int, origin.split("."))
            self.admit_result(turn, k)
        if end:
            number, status, *more = end
            self._read_end(source, number, status, (), *more)

    def _read_end(self, source: Input, number: int, status: str, digests: Iterable[int], *more: int) -> None:
        self.released = list(digests)
        self.end_turn(source, number, status, *more)


def leads_somewhere(digests: Iterable[int]) -> bool:
    """Whether one of these outputs leads to an address, or may do so."""
    return any(digest < LEADS_NOWHERE for digest in digests)


def said_of(out: Out) -> str:
    """What an output is, for people.

    >>> said_of(Out(1, "tell", "/app/cart", "shop:Sold")), said_of(Out(1, "effect", "charge"))
    ('tell of shop:Sold to /app/cart', 'effect charge')
    >>> said_of(Out(1, "timer", "0.1", "shop:Expire", seconds=1800.0))
    'timer of shop:Expire after 1800.0 s'
    >>> said_of(Out(1, "wait", "since then", "shop:Paid|shop:Cancel", seconds=60.0))
    'wait for shop:Paid or shop:Cancel, for 60 s at most'
    """
    if out.verb == "timer":  # `to` is the number by which its home knows it.
        again = f" and then every {out.interval} s" if out.interval else ""
        return f"timer of {out.name} after {out.seconds} s{again}"
    if out.verb == "sleep":  # `to` says from when on its seconds count, if that is no moment.
        return f"sleep for {out.seconds:g} s" if out.to else "sleep until a moment"
    if out.verb == "wait":
        limit = f", for {out.seconds:g} s at most" if out.seconds else ""
        return f"wait for {out.name.replace('|', ' or ')}{limit}"
    return f"{out.verb} of {out.name} to {out.to}" if ":" in out.name else f"{out.verb} {out.to}".strip()


def stop_entry(ends: EndWanted | None) -> Entry:
    """What the journal has of an end that a turn has asked for, or (None) of one that was dealt with."""
    return ("stop",) if ends is None else ("stop", *msgspec.structs.astuple(ends))


def outcome_entry(turn: int, k: int, answer: Came) -> Entry:
    """What the journal has of what came of an output."""
    return "got", turn, k, answer.kind, answer.name, answer.body, answer.nth, answer.after
