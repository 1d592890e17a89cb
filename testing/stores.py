"""What an engine of your own must do to be a store of holdfast: its conformance suite.

    from holdfast.testing.stores import conformance

    class TestMyStore(conformance(lambda path: MyJournal(path / "my.store"))):
        pass

`factory(path)` opens the store in that folder, which is empty the first time. A second call with the same folder comes
after the first engine was closed, or (`crash=`) left behind as a kill leaves it.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from ..actors.errors import HoldfastError
from ..checkpoint.journal import DamagedStore, Entry, Journal, Saved
from ..checkpoint.snapshot.shared_blocks import BLOCK, PAGE

Factory = Callable[[Path], Journal]
Crash = Callable[[Journal, Path], Path]
A, B = "/app/a", "/app/b"
STRANGE: list[Entry] = [
    ("in", 0, -1, 2**63, -(2**90), 1.5, float("inf"), True, False, None),
    ("in", "", "\u00e9\U0001f600", "\ud800", b"", bytes(range(256)), (), ((1, (2, "x")), None)),
    ("out", "x" * 100_000, b"y" * 1_000_000),
]
"""What must come back as it was, types included."""


def conformance(factory: Factory, *, crash: Crash | None = None) -> type[StoreConformance]:
    """A class of tests for the engine that `factory` opens; derive from it in a module that pytest collects.

    Args:
        factory: opens the engine in a folder.
        crash: given an open engine and its folder, makes a folder as a kill of the process would leave it now. Left
            out, nothing is tested of kills.
    """
    made: dict[str, Any] = {"factory": staticmethod(factory)}
    if crash is not None:
        made["crash"] = staticmethod(crash)
    return type("Conformance", (StoreConformance,), made)


def _blocks(seed: int) -> list[tuple[int, memoryview]]:
    """Blocks as a large snapshot has them: at multiples of a page, the last one of any length."""
    draw = random.Random(seed)
    pieces = (bytes(BLOCK), draw.randbytes(BLOCK), b"ab" * (PAGE // 2), draw.randbytes(PAGE + 5))
    places = (0, BLOCK, 2 * BLOCK + 3 * PAGE, 3 * BLOCK)
    return [(offset, memoryview(piece)) for offset, piece in zip(places, pieces, strict=True)]


class StoreConformance:
    """The suite. An engine that is not `durable` is held to less: what it reads back is empty."""

    factory: Factory
    crash: Crash | None = None

    @pytest.fixture
    def journal(self, tmp_path: Path) -> Iterator[Journal]:
        """An open, empty store."""
        with closing(self.factory(tmp_path)) as journal:
            yield journal

    def again(self, journal: Journal, path: Path) -> Journal:
        """Close it and open it again."""
        journal.close()
        return self.factory(path)

    def test_it_has_what_a_journal_has(self, journal: Journal) -> None:
        assert isinstance(journal.durable, bool)
        assert journal.epoch >= 1
        assert journal.addresses() == []
        assert journal.load(A) == Saved(None, 0, [])
        assert journal.noted("key") is None
        assert journal.notes("") == {}

    def test_positions_rise_over_all_addresses(self, journal: Journal) -> None:
        first = journal.append([(A, ("in", 1)), (B, ("in", 2)), (A, ("in", 3))])
        second = journal.append([(A, ("in", 4))])
        positions = [*first, *second]
        assert positions == sorted(set(positions))
        assert len(positions) == 4
        assert journal.append([]) == []

    def test_what_was_appended_comes_back_as_it_was(self, journal: Journal, tmp_path: Path) -> None:
        if not journal.durable:
            pytest.skip("it keeps nothing")
        positions = journal.append([(A, entry) for entry in STRANGE])
        assert journal.load(A).entries == list(zip(positions, STRANGE, strict=True))
        journal.sync()
        with closing(self.again(journal, tmp_path)) as reopened:
            found = reopened.load(A).entries
            assert found == list(zip(positions, STRANGE, strict=True))
            assert [list(map(type, entry)) for _, entry in found] == [list(map(type, entry)) for entry in STRANGE]
            assert reopened.addresses() == [A]
            assert reopened.append([(A, ("in", 9))])[0] > positions[-1]

    def test_the_epoch_rises_with_each_opening(self, journal: Journal, tmp_path: Path) -> None:
        if not journal.durable:
            pytest.skip("it has only one opening")
        before = journal.epoch
        with closing(self.again(journal, tmp_path)) as reopened:
            assert reopened.epoch > before

    def test_a_cut_keeps_the_snapshot_and_what_it_does_not_contain(self, journal: Journal, tmp_path: Path) -> None:
        if not journal.durable:
            journal.cut(A, b"state", [1], turn=1)
            return
        for size in (0, 10, 3 << 20):
            snapshot = random.Random(size).randbytes(size)
            positions = journal.append([(A, ("in", n)) for n in range(4)])
            journal.cut(A, snapshot, [*(p for p, _ in journal.load(A).entries[:-1]), 10**9], turn=size + 1)
            saved = journal.load(A)
            assert (saved.snapshot, saved.turn) == (snapshot, size + 1)
            assert saved.entries == [(positions[-1], ("in", 3))]
        with closing(self.again(journal, tmp_path)) as reopened:
            assert reopened.load(A) == saved

    def test_the_older_snapshot_stays_usable_with_all_entries_since(self, journal: Journal) -> None:
        if not journal.durable:
            pytest.skip("it keeps nothing")
        first = journal.append([(A, ("in", 1)), (A, ("in", 2))])
        journal.cut(A, b"older", first[:1], turn=1)
        second = journal.append([(A, ("in", 3))])
        journal.cut(A, b"newer", [first[1]], turn=2)
        older = journal.load(A, older=True)
        assert (older.snapshot, older.turn) == (b"older", 1)
        assert older.entries == [(first[1], ("in", 2)), (second[0], ("in", 3))]
        journal.cut(A, b"newest", second, turn=3, keep=1)
        assert journal.load(A, older=True) == journal.load(A) == Saved(b"newest", 3, [])

    @pytest.mark.parametrize("keep", [1, 2, 3, 5])
    def test_as_many_snapshots_can_be_gone_back_as_are_kept(self, journal: Journal, tmp_path: Path, keep: int) -> None:
        if not journal.durable:
            pytest.skip("it keeps nothing")
        positions: list[int] = []
        for turn in range(1, 7):
            positions += journal.append([(A, ("in", turn))])
            journal.cut(A, b"%d" % turn, positions[-1:], turn=turn, keep=keep)
        with closing(self.again(journal, tmp_path)) as reopened:
            for older in (0, 1, 2, 4, 9):
                turn = 6 - min(older, keep - 1)  # Never over the last one there is.
                entries: list[tuple[int, Entry]] = [(positions[n - 1], ("in", n)) for n in range(turn + 1, 7)]
                assert reopened.load(A, older=older) == Saved(b"%d" % turn, turn, entries)

    @pytest.mark.parametrize("compress", [False, True, 19])
    def test_blocks_come_back_at_their_places(self, journal: Journal, tmp_path: Path, compress: bool | int) -> None:
        if compress:
            pytest.importorskip("zstandard")
        if not journal.durable:
            self._keeps_no_blocks(journal)
            return
        blocks = _blocks(compress)
        places = [(offset, len(block)) for offset, block in blocks]
        journal.keep_blocks(A, 7, blocks, compress)
        with closing(self.again(journal, tmp_path)) as reopened:
            for wanted in (places, places[1:], places[:1], []):
                segment = reopened.read_blocks(A, 7, wanted)
                try:
                    assert segment.number == 7
                    for offset, block in blocks:
                        if (offset, len(block)) in wanted:
                            assert bytes(segment.block(offset, len(block))) == bytes(block)
                finally:
                    segment.close()

    def test_blocks_that_are_not_there_are_refused(self, journal: Journal) -> None:
        if not journal.durable:
            self._keeps_no_blocks(journal)
            return
        blocks = _blocks(0)
        offset, block = blocks[1]
        journal.keep_blocks(A, 7, blocks, False)
        for address, number, place in (
            (A, 8, (offset, len(block))),
            (B, 7, (offset, len(block))),
            (A, 7, (offset + 4096, len(block))),
            (A, 7, (offset, len(block) + 1)),
        ):
            with pytest.raises(DamagedStore):
                journal.read_blocks(address, number, [place])

    def test_blocks_that_no_snapshot_needs_can_be_forgotten(self, journal: Journal, tmp_path: Path) -> None:
        if not journal.durable:
            journal.forget_blocks(A, [])
            return
        for address, number in ((A, 1), (A, 2), (A, 1 << 55), (B, 2)):
            journal.keep_blocks(address, number, _blocks(number), False)
        journal.cut(A, b"of 2", [], turn=1)
        journal.forget_blocks(A, [2, 99])
        journal.forget_blocks("/unknown", [])
        with closing(self.again(journal, tmp_path)) as reopened:
            self._has_packs(reopened, {(A, 2), (B, 2)})
            reopened.erase(A)
            reopened.erase(B)  # It has blocks and nothing else.
            self._has_packs(reopened, set())

    def test_blocks_outlive_a_kill(self, journal: Journal, tmp_path: Path) -> None:
        if self.crash is None or not journal.durable:
            pytest.skip("nothing is known of kills")
        folder = tmp_path / "0"
        folder.mkdir()
        with closing(self.factory(folder)) as killed:
            killed.keep_blocks(A, 2, _blocks(2), False)
            copy = self.crash(killed, folder)
        with closing(self.factory(copy)) as reopened:
            self._has_packs(reopened, {(A, 2)})

    def _has_packs(self, journal: Journal, expected: set[tuple[str, int]]) -> None:
        for address, number in ((A, 1), (A, 2), (A, 1 << 55), (B, 2)):
            places = [(offset, len(block)) for offset, block in _blocks(number)]
            if (address, number) in expected:
                journal.read_blocks(address, number, places).close()
            else:
                with pytest.raises(DamagedStore):
                    journal.read_blocks(address, number, places)

    def _keeps_no_blocks(self, journal: Journal) -> None:
        journal.keep_blocks(A, 7, _blocks(0), False)
        with pytest.raises(DamagedStore):
            journal.read_blocks(A, 7, [(0, 4096)])

    def test_what_is_erased_is_gone_and_nothing_else_is(self, journal: Journal, tmp_path: Path) -> None:
        journal.append([(A, ("in", 1)), (B, ("in", 2))])
        journal.cut(A, b"x" * (2 << 20), [], turn=1)
        journal.erase(A)
        journal.erase("/unknown")
        assert journal.load(A) == Saved(None, 0, [])
        if journal.durable:
            with closing(self.again(journal, tmp_path)) as reopened:
                assert reopened.addresses() == [B]
                assert [entry for _, entry in reopened.load(B).entries] == [("in", 2)]
                reopened.append([(A, ("in", 5))])
                assert [entry for _, entry in reopened.load(A).entries] == [("in", 5)]

    def test_notes_are_kept_in_the_order_they_were_written(self, journal: Journal, tmp_path: Path) -> None:
        for key, value in (("child b", b"1"), ("child a", b""), ("other", b"3"), ("child b", b"4")):
            journal.note(key, value)
        journal.note("other", None)
        journal.note("never", None)
        expected = {"child a": b"", "child b": b"4"}
        assert list(journal.notes("child ").items()) == list(expected.items())
        assert (journal.noted("child b"), journal.noted("other")) == (b"4", None)
        if journal.durable:
            with closing(self.again(journal, tmp_path)) as reopened:
                assert list(reopened.notes("").items()) == list(expected.items())

    def test_what_is_no_entry_is_refused_and_nothing_of_its_append_is_there(self, journal: Journal) -> None:
        if not journal.durable:
            pytest.skip("it keeps nothing")
        wrong: list[Any] = [("in", [1]), ("in", {}), ("in", object()), (), [1]]
        for entry in wrong:
            with pytest.raises(TypeError):
                journal.append([(A, ("in", 1)), (A, entry)])
        assert journal.load(A).entries == []

    def test_a_second_close_does_nothing_and_what_is_closed_refuses(self, journal: Journal) -> None:
        journal.close()
        journal.close()
        if journal.durable:
            with pytest.raises(HoldfastError):
                journal.append([(A, ("in", 1))])

    @pytest.mark.parametrize("seed", range(5))
    def test_it_agrees_with_a_naive_model(self, tmp_path: Path, seed: int) -> None:
        """Any sequence of appends, cuts, erasures and openings (and kills) loads as a dictionary of lists does."""
        draw = random.Random(seed)
        folder = tmp_path / "0"
        folder.mkdir()
        journal = self.factory(folder)
        try:
            if journal.durable:
                self._compare(journal, folder, draw, f"seed {seed}")
        finally:
            journal.close()

    def _compare(self, journal: Journal, folder: Path, draw: random.Random, where: str) -> None:
        model: dict[str, tuple[bytes | None, int, dict[int, Entry]]] = {}
        actions = ["append"] * 4 + ["cut", "cut", "erase", "reopen"] + ["kill"] * (self.crash is not None)
        for step in range(40):
            address, action = draw.choice([A, B]), draw.choice(actions)
            snapshot, turn, entries = model.get(address, (None, 0, {}))
            if action == "append":
                batch = [(address, ("in", step, n)) for n in range(draw.randint(1, 5))]
                entries |= dict(zip(journal.append(batch), [entry for _, entry in batch], strict=True))
                model[address] = snapshot, turn, entries
            elif action == "cut":
                left = {position: entry for position, entry in entries.items() if draw.random() < 0.5}
                journal.cut(address, b"%d" % step, [p for p in entries if p not in left], turn=step)
                model[address] = b"%d" % step, step, left
            elif action == "erase":
                journal.erase(address)
                model.pop(address, None)
            elif action == "kill" and self.crash is not None:
                copy = self.crash(journal, folder)
                journal.close()
                journal, folder = self.factory(copy), copy
            else:
                journal = self.again(journal, folder)
            assert journal.addresses() == sorted(model), f"{where}, step {step}: {action}"
            for known, (state, after, kept) in model.items():
                found = journal.load(known)
                assert found[:3] == (state, after, list(kept.items())), f"{where}, step {step}: {action}"
        journal.close()
