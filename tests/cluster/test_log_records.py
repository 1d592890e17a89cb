"""What a reader of records makes of them: what is complete counts, what cannot be is refused."""

from __future__ import annotations

import pytest

from holdfast.cluster.log_records import (
    BASE,
    CHANGES,
    FORMAT,
    DamagedLog,
    EpochBegun,
    GapInLog,
    RecordMaker,
    RecordReader,
    Said,
)
from holdfast.cluster.ports import LogRecord


class Written:
    """Records as a leader writes them, one behind the other.

    Attributes:
        records: all of them.
    """

    def __init__(self) -> None:
        self.records: list[LogRecord] = []
        self.maker = RecordMaker(0, 0)

    def epoch(self, number: int, form: int = FORMAT) -> None:
        self.maker = RecordMaker(number, self.maker.after)
        self._append(self.maker.beginning(EpochBegun("somebody", f"attempt {number}", form, 0.0)))

    def write(self, kind: str, data: bytes, most: int | None = None) -> None:
        """Write all of it, or only so many parts."""
        for part, record in enumerate(self.maker.parts(kind, [data])):
            if part == most:
                return
            self._append(record)

    def _append(self, data: bytes) -> None:
        self.maker.after += 1
        self.records.append(LogRecord(self.maker.after, data))


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("holdfast.cluster.log_records.PART", 4)


@pytest.fixture
def written() -> Written:
    made = Written()
    made.epoch(1)
    return made


def read(records: list[LogRecord]) -> list[Said]:
    reader = RecordReader()
    return [said for record in records for said in reader.take(record)]


def said_in(records: list[LogRecord]) -> list[tuple[str, bytes]]:
    return [(said.kind, said.data) for said in read(records) if said.kind in (BASE, CHANGES)]


def test_what_has_all_its_parts_counts(written: Written) -> None:
    written.write(CHANGES, b"0123456789")
    written.write(CHANGES, b"")
    assert said_in(written.records) == [(CHANGES, b"0123456789"), (CHANGES, b"")]


def test_what_a_leader_did_not_finish_never_was(written: Written) -> None:
    written.write(CHANGES, b"0123456789", most=2)
    written.epoch(2)
    written.write(CHANGES, b"abcdefghij")
    assert said_in(written.records) == [(CHANGES, b"abcdefghij")]


def test_who_begins_with_a_base_takes_it_first(written: Written) -> None:
    written.write(BASE, b"0123", most=None)
    begins = len(written.records) - 1
    written.write(CHANGES, b"later")
    assert said_in(written.records[begins:]) == [(BASE, b"0123"), (CHANGES, b"later")]
    assert said_in(written.records) == [(CHANGES, b"later")]


def test_changes_between_the_parts_of_a_base_come_behind_it(written: Written) -> None:
    parts = written.maker.parts(BASE, [b"0123456789"])
    begins = len(written.records)
    for record in parts:
        written._append(record)
        written.write(CHANGES, b"12")
    assert said_in(written.records[begins:]) == [(BASE, b"0123456789"), *[(CHANGES, b"12")] * 3]


def test_a_base_that_is_not_finished_hides_no_growth(written: Written) -> None:
    def grown(records: list[LogRecord]) -> int:
        reader = RecordReader()
        for record in records:
            reader.take(record)
        return reader.grown

    written.write(CHANGES, b"0" * 100)
    before = grown(written.records)
    written.write(BASE, b"1" * 10, most=2)
    written.epoch(2)
    assert grown(written.records) > before
    written.write(BASE, b"1" * 10)
    assert grown(written.records) == 0


def test_a_base_that_the_log_begins_with_must_have_an_end(written: Written) -> None:
    written.write(BASE, b"0123456789", most=2)
    begun = written.records[1:]
    reader = RecordReader()
    for record in begun:
        reader.take(record)
    with pytest.raises(DamagedLog, match="was never finished"):
        reader.check_whole()
    written.epoch(2)
    with pytest.raises(DamagedLog, match="was never finished"):
        read(written.records[1:])


def test_a_missing_record_is_seen(written: Written) -> None:
    for _ in range(3):
        written.write(CHANGES, b"x")
    with pytest.raises(GapInLog, match=r"behind record 2, but 1 was the last one read"):
        read([*written.records[:1], *written.records[2:]])
    with pytest.raises(GapInLog, match=r"but 0 was"):
        read(written.records[1:])


def test_a_damaged_record_is_refused(written: Written) -> None:
    written.write(CHANGES, b"abcd")
    sequence, data = written.records[-1]
    assert data.endswith(b"abcd")
    with pytest.raises(DamagedLog, match="checksum"):
        read([*written.records[:-1], LogRecord(sequence, data[:-1] + b"x")])
    with pytest.raises(DamagedLog, match="no record of holdfast"):
        read([*written.records[:-1], LogRecord(sequence, b"hello")])


def test_parts_come_in_order(written: Written) -> None:
    first, second, _ = written.maker.parts(CHANGES, [b"0123456789"])
    assert first != second
    written._append(next(written.maker.parts(CHANGES, [b"0123456789"])))
    written._append(next(written.maker.parts(CHANGES, [b"0123456789"])))
    with pytest.raises(DamagedLog, match="it is part 0 of changes, and 1 came before it"):
        read(written.records)


@pytest.mark.parametrize("epoch", [1, 2, 4])
def test_epochs_rise_and_nobody_writes_in_anothers(written: Written, epoch: int) -> None:
    written.epoch(3)
    written.maker = RecordMaker(epoch, written.maker.after)
    written.write(CHANGES, b"x")
    with pytest.raises(DamagedLog, match=f"it is of epoch {epoch}, and stands behind epoch 3"):
        read(written.records)


def test_an_epoch_begins_once(written: Written) -> None:
    written.epoch(1)
    with pytest.raises(DamagedLog, match="it is of epoch 1, and stands behind epoch 1"):
        read(written.records)


def test_a_newer_format_is_not_read(written: Written) -> None:
    written.epoch(2, FORMAT + 1)
    with pytest.raises(DamagedLog, match="update this one"):
        read(written.records)
