"""What a home decides, as data: any order of admissions, turns, deaths and cuts, against a naive model and a journal.

The ledger is read back from the journal after each step, as the next root would: what is open, what is replayed, what
has left and what is counted must be what it was.
"""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from holdfast.actors.errors import ReplayDiverged
from holdfast.checkpoint.home.input_ledger import InputLedger, outcome_entry
from holdfast.checkpoint.inputs import OVERHEAD, Input, RowPlace
from holdfast.checkpoint.protocol import (
    DROPPED,
    FAILED,
    MESSAGE,
    OK,
    REPLY,
    START,
    STASHED,
    Answer,
    Came,
    Out,
    TurnEnd,
    answer_digest,
)
from holdfast.checkpoint.snapshot.snapshot_record import FORMAT, Meta

MOST = 3


def same(out: Out, digest: int) -> bool:
    return False


def same_reply(source: Input, digest: int, answer: Answer) -> bool:
    return digest == answer_digest(answer)


def outs_of(turn: int, count: int) -> list[Out]:
    return [Out(k, "tell", f"/to/{turn}") for k in range(1, count + 1)]


class Ledgers(RuleBasedStateMachine):
    """One home: its ledger, the journal that it would have written, and a model that forgets nothing."""

    def __init__(self) -> None:
        super().__init__()
        self.ledger = InputLedger("/app/doer")
        self.journal: dict[int, tuple[Any, ...]] = {}
        self.cut_at: Meta | None = None
        self.position = 0
        self.admitted: list[int] = []  # the model: all inputs, in order
        self.ended: dict[int, str] = {}  # how they have ended, if they have
        self.left: dict[int, int] = {}  # outputs that have left, by turn
        self.deaths: dict[int, int] = {}  # in the turn of an input, in a row
        self.stashed: set[int] = set()

    def write(self, entry: tuple[Any, ...], sink: list[int]) -> None:
        self.position += 1
        self.journal[self.position] = entry
        sink.append(self.position)

    def next_input(self) -> Input | None:
        """What the actor has in hand: the turn that has begun to send goes first."""
        ledger = self.ledger
        return ledger.open.get(ledger.begun) or next((one for one in ledger.waiting()), None)

    # -- admission --------------------------------------------------------------------------------------------------

    @rule(size=st.integers(0, 50))
    def admit(self, size: int) -> None:
        source = self.ledger.admit(MESSAGE, "m:Do", bytes(size), 0.0, None)
        source.positions = []
        self.write(source.entry(), source.positions)
        assert source.id == len(self.admitted), "numbers go on, whatever was forgotten"
        self.admitted.append(source.id)

    @rule(count=st.integers(2, 4), ended=st.integers(0, 3), gone=st.integers(0, 2))
    def admit_together(self, count: int, ended: int, gone: int) -> None:
        """Messages stand in one row; the turns of the first ones may be over, if nothing was in front of them."""
        ledger, place, ends = self.ledger, RowPlace([]), list[tuple[Any, ...]]()
        is_ahead = self.next_input() is None
        sources = [ledger.admit(MESSAGE, "m:Do", b"%d" % number, 0.5, "/app/other") for number in range(count)]
        for source in sources:
            source.positions, source.row = [], place
            place.left += 1
            self.admitted.append(source.id)
        for source in sources[: ended if is_ahead else 0]:
            number = ledger.turn + 1
            turn = ledger.end_turn(source, number, OK, 0, answer_digest(Answer()))
            _, _, _, status, _, *more = turn.entry(number)
            ends.append((source.id, number, status, *more))
            self.left[number], self.ended[source.id] = 0, OK
        inputs = tuple(part for source in sources for part in (source.id, source.time, source.body))
        self.write(("ins", "m:Do", "/app/other", inputs, *ends), place.positions)
        for source in [source for source in sources if source.id in ledger.open][:gone]:
            self._drop(source)

    @precondition(lambda self: self.ledger.open)
    @rule(data=st.data())
    def drop(self, data: st.DataObject) -> None:
        """It is superseded in its queue: an end without a turn."""
        waiting = [key for key in self.ledger.open if key not in self.stashed and key != self.ledger.begun]
        if not waiting:
            return
        self._drop(self.ledger.open[data.draw(st.sampled_from(waiting))])

    def _drop(self, source: Input) -> None:
        assert self.ledger.withdraw(source)
        assert not self.ledger.withdraw(source), "it ends once"
        position: list[int] = []
        self.ledger.drop(position)
        self.ledger.drop_input(source)
        self.write(("drop", source.id), position)
        self.ended[source.id] = "dropped"

    # -- turns ------------------------------------------------------------------------------------------------------

    @precondition(lambda self: self.next_input() is not None)
    @rule(count=st.integers(1, 2))
    def release(self, count: int) -> None:
        """Outputs leave before their turn ends."""
        ledger, source = self.ledger, self.next_input()
        assert source is not None
        turn, known = ledger.turn + 1, self.left.get(ledger.turn + 1, 0)
        outs = outs_of(turn, known + count)[known:]
        assert ledger.compare_outputs(turn, source.id, outs, same) == 0
        self.left[turn] = known + count
        self.write(ledger.released_entry(turn), ledger.positions_of(turn))

    @precondition(lambda self: self.next_input() is not None)
    @rule(status=st.sampled_from([OK, OK, FAILED, DROPPED, STASHED]), count=st.integers(0, 2))
    def end(self, status: str, count: int) -> None:
        ledger, source = self.ledger, self.next_input()
        assert source is not None
        number, known = ledger.turn + 1, self.left.get(ledger.turn + 1, 0)
        # The turn sends again what had left before its life died, and more.
        assert ledger.compare_outputs(number, source.id, outs_of(number, known + count), same) == known
        self.left[number] = known + count
        turn = ledger.end_turn(source, number, status)
        self.write(turn.entry(number), ledger.positions_of(number))
        self.deaths.pop(source.id, None)
        if status == STASHED:
            self.stashed.add(source.id)
        else:
            self.ended[source.id] = status

    @precondition(lambda self: self.next_input() is not None)
    @rule(most=st.integers(1, 4))
    def end_quietly(self, most: int) -> None:
        """Turns in a row let nothing out: one row has their ends."""
        ledger, first, keys = self.ledger, self.ledger.turn + 1, list[int]()
        while len(keys) < most and (source := self.next_input()) is not None and not self.left.get(ledger.turn + 1):
            self.left[ledger.turn + 1] = 0
            ledger.end_turn(source, ledger.turn + 1, OK)
            keys.append(source.id)
            self.deaths.pop(source.id, None)
            self.ended[source.id] = OK
        if keys:
            self.write(("ends", first, tuple(keys)), ledger.shared.ends.setdefault(ledger.turn, []))

    @precondition(lambda self: self.next_input() is None)
    @rule(reply=st.sampled_from([0, answer_digest(Answer())]), status=st.sampled_from([OK, FAILED, DROPPED]))
    def run_ahead(self, reply: int, status: str) -> None:
        """An ask is handled before it is written: one row has it and the end of its turn."""
        ledger, number = self.ledger, self.ledger.turn + 1
        source = ledger.admit(MESSAGE, "m:Do", b"ask", 0.0, None)
        source.positions = []
        self.admitted.append(source.id)
        turn = ledger.end_turn(source, number, status, 0, reply)
        _, _, _, _, _, *more = turn.entry(number)
        self.write((*source.entry(), number, status, *more), source.positions)
        self.left[number], self.ended[source.id] = 0, status

    @precondition(lambda self: self.stashed & self.ledger.open.keys())
    @rule()
    def end_of_the_stash(self) -> None:
        """The actor takes something up again: it is handled in a turn of its own."""
        if self.ledger.released:
            return
        source = self.ledger.open[min(self.stashed & self.ledger.open.keys())]
        number = self.ledger.turn + 1
        turn = self.ledger.end_turn(source, number, OK)
        self.write(turn.entry(number), self.ledger.positions_of(number))
        self.left[number], self.ended[source.id] = 0, OK
        self.stashed.discard(source.id)

    @rule(back=st.integers(0, 4), k=st.integers(1, 3))
    def get_an_outcome(self, back: int, k: int) -> None:
        ledger, answer = self.ledger, Answer(REPLY, "", b"1")
        turn = ledger.turn + 1 - back
        is_wanted = turn > ledger.state_turn
        source = self.next_input()
        if source is not None and self.left.get(ledger.turn + 1) and back == 0 and (turn, k) not in ledger.outcomes:
            self.deaths.pop(source.id, None)  # The turn in hand has come further.
        kept = ledger.note_outcome(turn, k, answer)
        assert (kept is not None) == is_wanted, "only what will be replayed is kept"
        if kept is not None:
            self.write(outcome_entry(turn, k, kept), ledger.positions_of(turn))

    # -- deaths and cuts --------------------------------------------------------------------------------------------

    @rule(is_ordered=st.booleans())
    def die(self, is_ordered: bool) -> None:
        source = self.next_input()
        running = -1 if source is None else source.id
        poison = self.ledger.count_death(running, is_ordered=is_ordered, most=MOST)
        if source is None or is_ordered:
            assert poison is None
            return
        self.deaths[running] = self.deaths.get(running, 0) + 1
        assert (poison is source) == (self.deaths[running] >= MOST)
        if poison is None:
            assert source.positions is not None
            self.write(("tried", running, source.deliveries), source.positions)
        else:  # Its turn ends with what it has sent.
            number = self.ledger.turn + 1
            turn = self.ledger.end_turn(source, number, DROPPED)
            self.write(turn.entry(number), self.ledger.positions_of(number))
            self.left.setdefault(number, 0)
            self.ended[running] = DROPPED
            del self.deaths[running]

    @precondition(lambda self: self.ledger.turn > self.ledger.state_turn)
    @rule(data=st.data())
    def cut(self, data: st.DataObject) -> None:
        """A snapshot of the last turn, or an image of an earlier one, is safe."""
        ledger = self.ledger
        turn = data.draw(st.integers(ledger.state_turn + 1, ledger.turn))
        later = {past.input.id for number, past in ledger.turns.items() if number > turn and past.status == STASHED}
        stash = sorted(key for key in ledger.stashed() & ledger.open.keys() if key not in later)
        contained = ledger.contained_in(turn)
        over = ledger.over_after(contained)
        meta = Meta(FORMAT, turn, ledger.next_id, stash, {}, [], 1, b"state", turn, over=over)
        for position in ledger.needless(contained):
            self.journal.pop(position, None)
        ledger.begin_with(meta, contained)
        self.cut_at = meta
        needed = {source.id for source in ledger.handled_and_open()} | {key for _, key in ledger.shared.gone}
        for entry in self.journal.values():
            if entry[0] == "ins":
                keys = set(entry[3][::3])
                assert keys & needed, "a row stays no longer than one of its inputs"
                assert keys - needed <= set(over)

    @precondition(lambda self: self.ledger.turns)
    @rule(data=st.data())
    def give_up(self, data: st.DataObject) -> None:
        """A full journal gives up what no replay needs: for the store, at the next snapshot."""
        ledger = self.ledger
        numbers = [number for number, turn in ledger.turns.items() if turn.status == OK and number != ledger.turn]
        if numbers:
            ledger.give_up(data.draw(st.sampled_from(numbers)))

    # -- what must be true ------------------------------------------------------------------------------------------

    def read_back(self) -> InputLedger:
        """The ledger as the next root would find it."""
        read = InputLedger("/app/doer")
        if self.cut_at is not None:
            read.begin_after(self.cut_at)
        for position, entry in sorted(self.journal.items()):
            assert read.read_entry(position, entry)
        return read

    @invariant()
    def nothing_is_lost_and_nothing_is_twice(self) -> None:
        still_open = [key for key in self.admitted if key not in self.ended]
        assert sorted(self.ledger.open) == still_open

    @invariant()
    def the_limit_counts_what_is_kept(self) -> None:
        ledger = self.ledger
        kept = [turn.input for turn in ledger.turns.values() if turn.status != STASHED] + list(ledger.open.values())
        assert ledger.journal_bytes == sum(len(source.body) + OVERHEAD for source in kept)

    @invariant()
    def the_next_root_finds_the_same(self) -> None:
        read, ledger = self.read_back(), self.ledger
        assert sorted(read.open) == sorted(ledger.open)
        in_the_queue = ledger.open.keys() - self.stashed
        assert all(read.open[key].deliveries == self.deaths.get(key, 0) for key in in_the_queue)
        assert (read.turn, read.begun, read.released) == (
            ledger.turn, ledger.begun if ledger.released else -1, ledger.released,
        )  # fmt: skip
        assert ledger.turns.keys() <= read.turns.keys(), "what was given up may still be in the store"
        for number, turn in ledger.turns.items():
            assert read.turns[number].entry(number) == turn.entry(number)
        assert ledger.outcomes.items() <= read.outcomes.items()
        assert {one.id for one in read.waiting()} == {one.id for one in ledger.waiting()}

    @invariant()
    def a_replay_that_does_the_same_is_taken(self) -> None:
        """All that left comes again and is dropped; another output, or one more, is refused."""
        ledger = self.ledger
        for number, turn in ledger.replayed(()):
            outs = outs_of(number, self.left[number])
            assert ledger.compare_outputs(number, turn.input.id, outs, same) == len(outs)
            end = TurnEnd(number, turn.input.id, turn.status, outs, Answer())
            ledger.judge_replay(end, len(outs), str, same_reply)
            with pytest.raises(ReplayDiverged):
                ledger.compare_outputs(number, turn.input.id, outs_of(number, len(outs) + 1), same)
            if outs:
                with pytest.raises(ReplayDiverged):
                    ledger.judge_replay(end, len(outs) - 1, str, same_reply)
                with pytest.raises(ReplayDiverged):
                    ledger.compare_outputs(number, turn.input.id, outs_of(-number - 2, len(outs)), same)

    @invariant()
    def the_image_of_a_group_says_the_same(self) -> None:
        ledger = self.ledger
        read = InputLedger("/app/doer")
        if ledger.newest is not None:
            read.begin_after(ledger.newest)
        for position, entry in enumerate(ledger.entries(), 1):
            assert read.read_entry(position, entry)
        assert sorted(read.open) == sorted(ledger.open)
        assert read.entries() == ledger.entries()


Ledgers.TestCase.settings = settings(max_examples=100, stateful_step_count=40, deadline=None)
TestLedgers = Ledgers.TestCase


def test_a_start_is_never_blamed() -> None:
    """Whether an actor that dies in its start begins again is its supervisor's business."""
    ledger = InputLedger("/app/doer")
    first = ledger.admit(START, "", b"", 0.0, None)
    assert ledger.start() is first
    assert ledger.count_death(first.id, is_ordered=False, most=1) is None
    assert first.was_cut
    assert first.deliveries == 0


def test_a_turn_that_comes_further_has_not_died_of_the_same() -> None:
    """An outcome that it has for the first time says so, also to the next root; what has no outcome does not."""
    ledger, read = InputLedger("/app/doer"), InputLedger("/app/doer")
    source = ledger.admit(MESSAGE, "m:Do", b"", 0.0, None)
    ledger.compare_outputs(0, source.id, outs_of(0, 1), same)
    got = outcome_entry(0, 1, Came(REPLY, "m:Done", b"", 1, 1))
    for entry in (source.entry(), ledger.released_entry(0), ("tried", source.id, 2), got, ("tried", source.id, 1)):
        assert read.read_entry(0, entry)
    assert ledger.count_death(source.id, is_ordered=False, most=2) is None
    assert ledger.note_outcome(0, 1, Answer(REPLY, "m:Done", b""))
    assert ledger.count_death(source.id, is_ordered=False, most=2) is None
    assert read.open[source.id].deliveries == source.deliveries == 1
    assert ledger.note_outcome(0, 1, Answer(REPLY, "m:Done", b""))
    assert ledger.count_death(source.id, is_ordered=False, most=2) is source
    assert read.read_entry(0, got)
    assert read.open[source.id].deliveries == 1


def test_the_turn_that_has_begun_to_send_goes_first() -> None:
    """Its outputs have the next number: another turn would be taken for one that sends something else."""
    ledger = InputLedger("/app/doer")
    one, two = (ledger.admit(MESSAGE, "m:Do", b"", 0.0, None) for _ in range(2))
    ledger.compare_outputs(0, two.id, [Out(1, "tell", "/to")], same)
    assert ledger.waiting() == [two, one]
    with pytest.raises(ReplayDiverged):
        ledger.compare_outputs(0, one.id, [], same)


def test_background_work_has_one_result() -> None:
    """A life that begins it again brings a second one."""
    ledger = InputLedger("/app/doer")
    assert [ledger.admit_result(3, 1), ledger.admit_result(3, 1), ledger.admit_result(3, 2)] == [True, False, True]


def row_of(ledger: InputLedger, position: int, count: int) -> tuple[list[Input], tuple[Any, ...]]:
    """Messages that stand in one row, and the row."""
    place = RowPlace([position], count)
    sources = [ledger.admit(MESSAGE, "m:Do", b"", 0.5, None) for _ in range(count)]
    for source in sources:
        source.positions, source.row = [], place
    inputs = tuple(part for source in sources for part in (source.id, source.time, source.body))
    return sources, ("ins", "m:Do", None, inputs)


def snapshot(ledger: InputLedger, turn: int, journal: dict[int, tuple[Any, ...]]) -> Meta:
    stash = sorted(ledger.stashed() & ledger.open.keys())
    contained = ledger.contained_in(turn)
    over = ledger.over_after(contained)
    meta = Meta(FORMAT, turn, ledger.next_id, stash, {}, [], 1, b"state", turn, over=over)
    for position in ledger.needless(contained):
        journal.pop(position, None)
    ledger.begin_with(meta, contained)
    return meta


def read(meta: Meta, journal: dict[int, tuple[Any, ...]]) -> InputLedger:
    found = InputLedger("/app/doer")
    found.begin_after(meta)
    for position, entry in journal.items():
        assert found.read_entry(position, entry)
    return found


def test_what_ends_without_a_turn_is_contained_once() -> None:
    """It was put aside in a turn before: its row stays for the message that nobody has handled."""
    ledger, journal = InputLedger("/app/doer"), dict[int, tuple[Any, ...]]()
    (aside, handled, waits), journal[1] = row_of(ledger, 1, 3)
    ledger.end_turn(aside, 0, STASHED)
    ledger.withdraw(aside)
    ledger.drop_input(aside)
    ledger.end_turn(handled, 1, OK)
    meta = snapshot(ledger, 1, journal)
    assert [*read(meta, journal).open] == [waits.id]


def test_what_is_handled_behind_an_image_stays() -> None:
    """It had been put aside when the image was begun, and has been handled when that is kept."""
    ledger, journal = InputLedger("/app/doer"), dict[int, tuple[Any, ...]]()
    (aside, handled), journal[1] = row_of(ledger, 1, 2)
    ledger.end_turn(aside, 0, STASHED)
    ledger.end_turn(handled, 1, OK)
    journal[2] = ledger.end_turn(aside, 2, OK).entry(2)
    ledger.positions_of(2).append(2)
    meta = snapshot(ledger, 1, journal)
    assert meta.over == [handled.id]
    found = read(meta, journal)
    assert [(number, turn.input.id) for number, turn in found.turns.items()] == [(2, aside.id)]
    assert not found.open


def test_a_row_of_which_much_is_over_for_long() -> None:
    """One message of a row was put aside: the others are over in each snapshot, until that one is."""
    ledger, journal = InputLedger("/app/doer"), dict[int, tuple[Any, ...]]()
    sources, journal[1] = row_of(ledger, 1, 3)
    ledger.end_turn(sources[0], 0, STASHED)
    for number, source in enumerate(sources[1:], 1):
        ledger.end_turn(source, number, OK)
    for turn in (2, 3, 4):
        meta = snapshot(ledger, turn, journal)
        assert sorted(meta.over) == [1, 2]
        found = read(meta, journal)
        assert [*found.open] == [0]
        assert sorted(found.over_after(found.contained_in(turn))) == [1, 2], "the next program knows it, too"
        [later], journal[turn + 10] = row_of(ledger, turn + 10, 1)
        ledger.end_turn(later, turn + 1, OK)
    ledger.end_turn(sources[0], 6, OK)
    assert snapshot(ledger, 6, journal).over == []
    assert journal == {}


def test_what_was_put_aside_is_not_forgotten_before_the_turn_that_did_it() -> None:
    ledger, journal = InputLedger("/app/doer"), dict[int, tuple[Any, ...]]()
    sources, journal[1] = row_of(ledger, 1, 2)
    for position, (source, number, status) in enumerate(
        [(sources[0], 0, OK), (sources[1], 1, STASHED), (sources[1], 2, OK)], 2
    ):
        journal[position] = ledger.end_turn(source, number, status).entry(number)
        ledger.positions_of(number).append(position)
    ledger.give_up(2)
    found = read(snapshot(ledger, 0, journal), journal)  # An image that was begun early.
    assert found.open == {}
    assert found.turns[1].status == STASHED
    snapshot(ledger, 2, journal)
    assert journal == {}
