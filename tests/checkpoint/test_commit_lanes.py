"""The two lanes of the group commit against a naive model: nothing takes effect too early, twice or out of order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from holdfast.actors.errors import HoldfastError
from holdfast.checkpoint.commit_lanes import CommitLanes

QUICK, SLOW, UNKNOWN = "/app/quick", "/app/slow", "/app/not_started"
ALL = [QUICK, SLOW, UNKNOWN]


class Note:
    """A submission of some homes; what becomes of it is noted."""

    weight = 1

    def __init__(self, number: int, paths: list[str], *, may_be_refused: bool) -> None:
        self.number, self.may_be_refused = number, may_be_refused
        self.entries = tuple((path, ("in", number)) for path in paths)
        self.positions: list[int] = []
        self.is_refused = self.is_abandoned = self.is_synced = False

    @property
    def paths(self) -> set[str]:
        return {path for path, _ in self.entries}

    def written(self, positions: Sequence[int]) -> None:
        assert not self.positions, "it is written once"
        assert len(positions) == len(self.entries)
        self.positions = list(positions)

    def safe(self) -> None:
        raise AssertionError("whoever runs the lanes lets it take effect")

    def refused(self, error: HoldfastError) -> bool:
        self.is_refused = self.may_be_refused
        return self.may_be_refused

    def abandoned(self, error: HoldfastError) -> None:
        self.is_abandoned = True


class Lanes(RuleBasedStateMachine):
    def __init__(self) -> None:
        super().__init__()
        self.lanes = CommitLanes()
        self.lanes.want(QUICK, is_synced=False)
        self.lanes.want(SLOW, is_synced=True)
        self.all: list[Note] = []
        self.done: list[Note] = []
        self.position = 0

    @rule(paths=st.lists(st.sampled_from(ALL), min_size=1, max_size=3), may=st.booleans())
    def submit(self, paths: list[str], may: bool) -> None:
        note = Note(len(self.all), paths, may_be_refused=may)
        self.all.append(note)
        self.lanes.submit(note)

    @rule(most=st.integers(1, 4))
    def write(self, most: int) -> None:
        pending = self.lanes.pending[:most]
        count = sum(len(note.entries) for note, _ in pending)
        counts = [len(note.entries) for note, _ in pending]
        self.lanes.take_written(counts, range(self.position, self.position + count))
        self.position += count

    @rule(behind=st.integers(0, 2))
    def sync(self, behind: int) -> None:
        """A sync that was begun some submissions ago is over."""
        number = max(self.lanes.synced, self.lanes.written - behind)
        for done, note in self.lanes.unsynced:
            note.is_synced = note.is_synced or done <= number  # type: ignore[attr-defined]
        self.lanes.take_synced(number)

    @rule()
    def run(self) -> None:
        while self.lanes.ready:
            note: Any = self.lanes.ready.popleft()
            assert note.positions, "what takes effect is written"
            if note.paths & {SLOW, UNKNOWN}:
                assert note.is_synced, "and synced, if any of its homes wants that, or may want it"
            self.done.append(note)

    @rule()
    def refuse(self) -> None:
        """The store has no room: what comes from outside is refused, the rest waits in its order."""
        before = [note for note, _ in self.lanes.pending]
        self.lanes.refuse(HoldfastError("full"))
        assert [note for note, _ in self.lanes.pending] == [note for note in before if not note.is_refused]  # type: ignore[attr-defined]

    @invariant()
    def each_home_keeps_its_order(self) -> None:
        """Also across lanes: whoever has something in the slow one stays there with all that follows."""
        for path in ALL:
            numbers = [note.number for note in self.done if path in note.paths]
            assert numbers == sorted(set(numbers))
            if numbers:  # Nothing was overtaken by what has taken effect.
                earlier = {
                    note.number for note in self.all[: numbers[-1]] if path in note.paths and not note.is_refused
                }
                assert earlier <= set(numbers)

    @invariant()
    def everything_is_somewhere(self) -> None:
        lanes = self.lanes
        inside = [*(n for n, _ in lanes.pending), *(n for _, n in lanes.unsynced), *lanes.ready]
        left = [note for note in self.all if note not in self.done and not note.is_refused]
        assert sorted(note.number for note in inside) == [note.number for note in left]  # type: ignore[attr-defined]
        assert lanes.is_empty == (not left)
        assert lanes.is_urgent or all(number for _, number in lanes.pending), "the quick lane never waits for a sync"

    def teardown(self) -> None:
        """The store has failed for good: nothing takes effect that was not safe, and everybody hears of it."""
        ready = list(self.lanes.ready)
        self.lanes.abandon(HoldfastError("failed"))
        assert not self.lanes.pending
        assert not self.lanes.unsynced
        for note in self.all:
            outcomes = note in self.done, note in ready, note.is_refused, note.is_abandoned
            assert outcomes.count(True) == 1


Lanes.TestCase.settings = settings(max_examples=100, stateful_step_count=30, deadline=None)
TestLanes = Lanes.TestCase
