"""Every journal engine keeps the same promises; the durable one keeps them through kills, rivals and damage."""

from __future__ import annotations

import math
import os
import random
import select
import shutil
import signal
import sqlite3
import stat
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from holdfast.actors.errors import HoldfastError
from holdfast.checkpoint.journal import (
    DamagedStore,
    Entry,
    Journal,
    MemoryJournal,
    Saved,
    StaleEpoch,
    StoreFailed,
    StoreInUse,
)
from holdfast.checkpoint.sqlite import SqliteJournal
from holdfast.checkpoint.sqlite import store as sqlite_store
from holdfast.checkpoint.sqlite.chains import Chain
from holdfast.checkpoint.sqlite.claim import Claim
from holdfast.checkpoint.sqlite.rows import crc_of

A, B = "/app/bank/alice", "/app/bank/bob"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "app.db"


@pytest.fixture
def store(path: Path) -> Iterator[SqliteJournal]:
    with closing(SqliteJournal(path)) as journal:
        yield journal


@pytest.fixture(params=["memory", "os", "fsync"])
def journal(request: pytest.FixtureRequest, path: Path) -> Iterator[Journal]:
    engine: Journal = MemoryJournal() if request.param == "memory" else SqliteJournal(path, synchronous=request.param)
    with closing(engine):
        yield engine


def inputs(count: int, address: str = A, start: int = 0) -> list[tuple[str, Entry]]:
    return [(address, ("in", number)) for number in range(start, start + count)]


def numbers(saved: Saved) -> list[Any]:
    return [entry[1] for _, entry in saved.entries]


def reopened(path: Path) -> Saved:
    with closing(SqliteJournal(path)) as journal:
        return journal.load(A)


def edit(path: Path, *statements: str) -> None:
    """Damage a closed store behind its back."""
    with closing(sqlite3.connect(path, isolation_level=None)) as db:
        for statement in statements:
            db.execute(statement)


def flip(path: Path, bit: int) -> None:
    data = bytearray(path.read_bytes())
    data[bit // 8] ^= 1 << bit % 8
    path.write_bytes(data)


# ---- what every engine promises


def test_positions_rise(journal: Journal) -> None:
    positions = [*journal.append(inputs(1)), *journal.append(inputs(3)), *journal.append([])]
    journal.cut(A, b"s", positions, turn=4)
    positions += journal.append([*inputs(2, B), *inputs(1)])
    assert len(positions) == 7
    assert positions == sorted(set(positions))
    assert all(type(position) is int for position in positions)


def test_unknown_addresses_are_empty(journal: Journal) -> None:
    assert journal.load("/nobody") == (None, 0, [], "")
    journal.erase("/nobody")


def test_notes_are_kept_and_forgotten(journal: Journal) -> None:
    assert journal.noted("children") is None
    for value in (b"one", b"", b"two"):
        journal.note("children", value)
        assert journal.noted("children") == value
    journal.note("children", None)
    journal.note("children", None)
    assert journal.noted("children") is None


def test_load_gives_what_was_appended_if_anything_is_durable(journal: Journal) -> None:
    journal.append([*inputs(2), *inputs(2, B), *inputs(1, start=2)])
    assert numbers(journal.load(A)) == ([0, 1, 2] if journal.durable else [])
    assert journal.addresses() == ([A, B] if journal.durable else [])
    journal.erase(A)
    assert journal.load(A) == (None, 0, [], "")
    assert journal.addresses() == ([B] if journal.durable else [])


def test_close_twice(journal: Journal) -> None:
    journal.close()
    journal.close()


@pytest.mark.parametrize(
    "error",
    [
        StoreInUse("/app.db", 7),
        StaleEpoch("/app.db", 1, 2),
        DamagedStore("/app.db", A, 3, "bit"),
        DamagedStore("/app.db", None, None, "bit"),
        StoreFailed("/app.db", "no space"),
    ],
)
def test_errors_can_be_rebuilt_and_say_where(error: HoldfastError) -> None:
    again = type(error)(*error.args)
    assert str(again) == str(error)
    assert vars(again) == vars(error)
    assert all(str(argument) in str(error) for argument in error.args if argument is not None)


# ---- entries


def same(one: object, two: object) -> bool:
    """Equal in type and value, all the way down; NaN is itself, and -0.0 is not 0.0."""
    if type(one) is not type(two):
        return False
    if isinstance(one, tuple) and isinstance(two, tuple):
        return len(one) == len(two) and all(map(same, one, two))
    if isinstance(one, float) and isinstance(two, float):
        return (math.isnan(one) and math.isnan(two)) or (one == two and math.copysign(1, one) == math.copysign(1, two))
    return one == two


scalars = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.integers(-(2**200), 2**200),
    st.floats(),
    st.text(st.characters()),  # lone surrogates too
    st.binary(),
)
values = st.recursive(scalars, lambda inner: st.lists(inner, max_size=4).map(tuple), max_leaves=12)
written = st.tuples(
    st.sampled_from([A, B, "", "/ä\n'\""]),
    st.tuples(st.sampled_from(["in", "out", "got", "end", "note"]), st.lists(values, max_size=5)).map(
        lambda pair: (pair[0], *pair[1])
    ),
)


@given(batches=st.lists(st.lists(written, max_size=5), max_size=5))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=40)
def test_entries_come_back_exactly(path: Path, batches: list[list[tuple[str, Entry]]]) -> None:
    shutil.rmtree(path.parent)
    path.parent.mkdir()
    expected: dict[str, list[tuple[int, Entry]]] = {}
    with closing(SqliteJournal(path)) as journal:
        for batch in batches:
            for (address, entry), position in zip(batch, journal.append(batch), strict=True):
                expected.setdefault(address, []).append((position, entry))
    with closing(SqliteJournal(path)) as journal:
        assert journal.addresses() == sorted(expected)
        assert all(same(tuple(journal.load(address).entries), tuple(rows)) for address, rows in expected.items())


@pytest.mark.parametrize("bad", [[1], {1: 2}, {1}, bytearray(b"x"), signal.SIGTERM, object(), 1j])
def test_what_would_not_come_back_is_refused_and_nothing_is_written(store: SqliteJournal, bad: Any) -> None:
    for entry in (("in", bad), ("in", (1, (bad,))), (1, "in"), (), ["in"]):
        with pytest.raises(TypeError):
            store.append([*inputs(1), (A, entry)])  # type: ignore[list-item]
    assert store.append(inputs(1)) == [1]
    assert numbers(store.load(A)) == [0]


# ---- snapshots and cuts


@pytest.mark.parametrize("size", [0, 1 << 20, (1 << 20) + 1, 5 << 20])
def test_a_snapshot_and_what_it_does_not_contain_survive(path: Path, size: int) -> None:
    snapshot = random.Random(size).randbytes(size)
    with closing(SqliteJournal(path)) as journal:
        positions = journal.append(inputs(5))
        journal.cut(A, snapshot, [positions[3], positions[0]], turn=7)
        assert numbers(journal.load(A)) == [1, 2, 4]
    saved = reopened(path)
    assert (saved.snapshot, saved.turn, numbers(saved)) == (snapshot, 7, [1, 2, 4])


def test_dropped_entries_are_removed_by_the_next_cut(path: Path) -> None:
    big = b"x" * (2 << 20)
    with closing(SqliteJournal(path)) as journal:
        for turn in range(1, 6):
            positions = journal.append(inputs(2, start=10 * turn))
            journal.cut(A, big, range(positions[0], positions[1] + 1), turn=turn)
            rows = sqlite3.connect(path)
            assert rows.execute("SELECT count(*) FROM entries").fetchone() == (2,)
            assert rows.execute("SELECT count(*) FROM snapshots").fetchone() == (min(turn, 2),)
            rows.close()
            assert len(os.listdir(f"{path}-snapshots")) == min(turn, 2)
        assert numbers(journal.load(A)) == []
        older = journal.load(A, older=True)
        assert (older.turn, numbers(older)) == (4, [50, 51])
    assert reopened(path).turn == 5


def test_many_interleaved_entries_are_dropped(path: Path) -> None:
    with closing(SqliteJournal(path)) as journal:
        mine = journal.append([(A if n % 3 else B, ("in", n)) for n in range(5000)])
        mine = [position for position, n in zip(mine, range(5000), strict=True) if n % 3]
        journal.cut(A, b"1", mine[:-1], turn=1)
        journal.cut(A, b"2", [], turn=2)
        assert [position for position, _ in journal.load(A).entries] == mine[-1:]
        assert len(journal.load(B).entries) == 1667
        assert journal._store.live == 1668
    assert numbers(reopened(path)) == [4999]


def test_positions_that_the_address_has_not_are_ignored(store: SqliteJournal) -> None:
    store.append([*inputs(1, B), *inputs(1)])
    store.cut(A, b"1", range(1000), turn=1)
    store.cut(A, b"2", range(1000), turn=2)
    assert numbers(store.load(A)) == []
    assert numbers(store.load(B)) == [0]


@given(data=st.data())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=25)
def test_the_store_agrees_with_a_naive_model(path: Path, data: st.DataObject) -> None:
    """Any sequence of appends, cuts, erases and reopenings loads as a dictionary of lists does."""
    shutil.rmtree(path.parent)
    path.parent.mkdir()
    journal = SqliteJournal(path)
    model: dict[str, tuple[bytes | None, int, dict[int, Entry]]] = {}
    for step in range(data.draw(st.integers(1, 12))):
        address = data.draw(st.sampled_from([A, B]))
        action = data.draw(st.sampled_from(["append", "append", "cut", "cut", "erase", "reopen", "kill"]))
        snapshot, turn, entries = model.get(address, (None, 0, {}))
        if action == "append":
            batch = inputs(data.draw(st.integers(1, 4)), address, 10 * step)
            entries |= dict(zip(journal.append(batch), [entry for _, entry in batch], strict=True))
            model[address] = snapshot, turn, entries
        elif action == "cut":
            drop = [position for position in entries if data.draw(st.booleans())]
            journal.cut(address, b"%d" % step, drop, turn=step)
            left = {position: entry for position, entry in entries.items() if position not in drop}
            model[address] = b"%d" % step, step, left
        elif action == "erase":
            journal.erase(address)
            model.pop(address, None)
        else:
            journal = abandon(journal) if action == "kill" else closed(journal)
        assert journal.addresses() == sorted(model)
        for known, (snapshot, turn, entries) in model.items():
            assert journal.load(known) == (snapshot, turn, list(entries.items()), "")
    journal.close()


def closed(journal: SqliteJournal) -> SqliteJournal:
    journal.close()
    return SqliteJournal(journal.path)


def abandon(journal: SqliteJournal) -> SqliteJournal:
    """Open a copy of the files as they are: what a kill would leave."""
    folder = Path(journal.path).parent
    copy = folder.parent / f"{folder.name}-copy"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(folder, copy)
    journal.close()
    shutil.rmtree(folder)
    shutil.copytree(copy, folder)
    with closing(sqlite3.connect(journal.path, isolation_level=None)) as db:
        row = db.execute("SELECT epoch, pid, start, floor, live FROM store").fetchone()
        dead = (row[0], 0, "", row[3], row[4])
        db.execute("UPDATE store SET pid = 0, start = '', crc = ?", (crc_of(*dead),))
    return SqliteJournal(journal.path)


def test_an_address_that_is_erased_starts_afresh(path: Path) -> None:
    with closing(SqliteJournal(path)) as journal:
        first = journal.append(inputs(3))
        journal.cut(A, b"x" * (2 << 20), first[:1], turn=1)
        journal.erase(A)
        assert os.listdir(f"{path}-snapshots") == []
        assert journal.append(inputs(1, start=7))[0] > first[-1]
        assert journal.load(A)[:2] == (None, 0)
    assert numbers(reopened(path)) == [7]


def test_positions_are_not_used_again_after_everything_was_removed(path: Path) -> None:
    with closing(SqliteJournal(path)) as journal:
        last = journal.append(inputs(3))[-1]
        journal.erase(A)
    with closing(SqliteJournal(path)) as journal:
        assert journal.append(inputs(1))[0] > last


def test_a_cut_whose_file_cannot_be_written_changes_nothing(store: SqliteJournal, path: Path) -> None:
    positions = store.append(inputs(2))
    store.cut(A, b"1", positions[:1], turn=1)
    shutil.rmtree(f"{path}-snapshots")
    with pytest.raises(StoreFailed, match="snapshot not written"):
        store.cut(A, b"x" * (2 << 20), positions, turn=2)
    assert (store.load(A).snapshot, numbers(store.load(A))) == (b"1", [1])
    store.append(inputs(1, start=5))  # The journal goes on.
    assert numbers(store.load(A)) == [1, 5]


def test_orphan_files_are_removed_at_the_opening(path: Path) -> None:
    with closing(SqliteJournal(path)) as journal:
        journal.cut(A, b"x" * (2 << 20), [], turn=1)
    folder = Path(f"{path}-snapshots")
    for name in ("1-99.snapshot", "1-98.snapshot.tmp", "new-1-1"):
        (folder / name).write_bytes(b"x")
    assert reopened(path).turn == 1
    assert os.listdir(folder) == ["1-1.snapshot"]


def test_files_are_for_the_owner_only(store: SqliteJournal, path: Path) -> None:
    store.cut(A, b"x" * (2 << 20), [], turn=1)
    files = [*path.parent.glob("app.db*"), *Path(f"{path}-snapshots").iterdir()]
    assert {stat.S_IMODE(file.stat().st_mode) & 0o077 for file in files} == {0}


def test_a_missing_folder_is_not_made(tmp_path: Path) -> None:
    with pytest.raises(StoreFailed):
        SqliteJournal(tmp_path / "no" / "app.db")
    assert os.listdir(tmp_path) == []


def test_appends_go_on_while_other_threads_cut_and_load(store: SqliteJournal) -> None:
    positions = store.append(inputs(3000, B))
    errors: list[BaseException] = []

    def cut_and_load() -> None:
        try:
            for turn in range(1, 4):
                store.cut(B, b"x" * (3 << 20), positions[: 1000 * turn], turn=turn)
                assert len(store.load(B).entries) == 3000 - 1000 * turn
        except BaseException as error:  # shown by the main thread
            errors.append(error)

    thread = threading.Thread(target=cut_and_load)
    thread.start()
    count = 0
    while thread.is_alive():
        store.append(inputs(1, start=count))
        count += 1
    thread.join()
    assert errors == []
    assert numbers(store.load(A)) == list(range(count))


def test_the_wal_is_brought_into_the_database_meanwhile(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sqlite_store, "_CHECKPOINT_BYTES", 1 << 16)
    monkeypatch.setattr(sqlite_store, "_WAL_FRAMES", 64)
    with closing(SqliteJournal(path)) as journal:
        sizes, count = [-1, 0], 0
        while sizes[-1] != sizes[-2]:  # The file does not shrink, but once it is written over it does not grow either.
            assert count < 40_000, f"the WAL only grows: {sizes}"
            for number in range(count, count + 500):
                journal.append(inputs(1, start=number))
            count += 500
            sizes.append(os.path.getsize(f"{path}-wal"))
    assert numbers(reopened(path)) == list(range(count))


def test_a_broken_off_transaction_leaves_no_trace(store: SqliteJournal, monkeypatch: pytest.MonkeyPatch) -> None:
    positions = store.append(inputs(2))
    for interrupted in (Chain, Claim):
        with monkeypatch.context() as patch:
            patch.setattr(interrupted, "write", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
            with pytest.raises(KeyboardInterrupt):
                store.cut(A, b"1", positions, turn=1)
            if interrupted is Chain:
                with pytest.raises(KeyboardInterrupt):
                    store.append([*inputs(1), *inputs(1, "/new")])
        assert store.load(A) == (None, 0, list(zip(positions, [("in", 0), ("in", 1)], strict=True)), "")
    assert store.append(inputs(1, "/new"))[0] == positions[-1] + 1
    assert store.addresses() == [A, "/new"]


def test_a_foreign_lock_is_named_and_passes(store: SqliteJournal, path: Path) -> None:
    with closing(sqlite3.connect(path, isolation_level=None)) as rival:
        rival.execute("BEGIN IMMEDIATE")
        with pytest.raises(StoreFailed, match="try again"):
            store.append(inputs(1))
        rival.execute("ROLLBACK")
    assert store.append(inputs(1)) == [1]


# ---- owners


CHILD = """
import os, random, signal, sys
from holdfast.checkpoint.sqlite import SqliteJournal
path, what, seed = sys.argv[1], sys.argv[2], int(sys.argv[3])
journal = SqliteJournal(path, synchronous="fsync" if seed % 2 else "os")
print("open", journal.epoch, flush=True)
choose = random.Random(seed)
if what == "hold":
    journal.append([("/app/bank/alice", ("in", 1))])
    print("held", flush=True)
    sys.stdin.read()
if what == "stop":  # in the middle of a transaction, with SQLite's write lock held
    with journal._store.transaction():
        os.kill(os.getpid(), signal.SIGSTOP)
number, live, done = 0, {0: [], 1: []}, 0
while what == "write":
    size = choose.choice([1, 1, 2, 7, 40])
    batch = [(f"/{(number + n) % 2}", ("in", number + n, size, n, "x" * choose.randrange(200))) for n in range(size)]
    for (address, _), position in zip(batch, journal.append(batch)):
        live[int(address[1])].append(position)
    number += size
    os.write(1, b"%d\\n" % number)  # acknowledged
    if choose.random() < 0.1:
        owner = choose.randrange(2)
        snapshot = b"%d " % (number) + b"x" * choose.choice([10, 3 << 20])
        journal.cut(f"/{owner}", snapshot, live[owner], turn=number)
        live[owner] = []
        os.write(1, b"cut %d %d\\n" % (owner, number))
"""


def spawn(path: Path, what: str, seed: int = 0) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-c", CHILD, str(path), what, str(seed)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )


def end(child: subprocess.Popen[bytes]) -> bytes:
    """Kill the child; return what it had still said."""
    child.kill()
    return child.communicate()[0]


def line(child: subprocess.Popen[bytes]) -> bytes:
    assert child.stdout is not None
    return child.stdout.readline()


def test_the_epoch_rises_at_each_opening(path: Path) -> None:
    epochs = []
    for _ in range(3):
        with closing(SqliteJournal(path)) as journal:
            epochs.append(journal.epoch)
    assert epochs == [1, 2, 3]


def test_this_process_cannot_open_it_twice(store: SqliteJournal, path: Path) -> None:
    path.with_name("link").symlink_to(path)
    for name in (path, path.with_name("link"), os.path.relpath(path)):
        for takeover in (False, True):
            with pytest.raises(StoreInUse) as caught:
                SqliteJournal(name, takeover=takeover)
            assert caught.value.args == (str(path), os.getpid())
    store.append(inputs(1))


@pytest.mark.parametrize("what", ["hold", "stop"])
def test_a_living_owner_is_named_and_a_stopped_one_taken_over(path: Path, what: str) -> None:
    child = spawn(path, what)
    try:
        assert line(child) == b"open 1\n"
        if what == "hold":
            assert line(child) == b"held\n"
            child.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, child.pid, os.WSTOPPED)
        with pytest.raises(StoreInUse) as caught:
            SqliteJournal(path)
        assert caught.value.pid == child.pid
        with closing(SqliteJournal(path, takeover=True)) as journal:
            assert child.wait() == -signal.SIGKILL
            assert journal.epoch == 2
            assert numbers(journal.load(A)) == ([1] if what == "hold" else [])
            journal.append(inputs(1))
    finally:
        end(child)


def test_a_stopped_process_that_shuts_everybody_out_is_found_by_its_lock(path: Path) -> None:
    SqliteJournal(path).close()
    script = (
        "import os, signal, sqlite3, sys; db = sqlite3.connect(sys.argv[1], isolation_level=None)\n"
        "db.execute('PRAGMA locking_mode = EXCLUSIVE'); db.execute('BEGIN EXCLUSIVE')\n"
        "db.execute('SELECT * FROM store'); os.kill(os.getpid(), signal.SIGSTOP)"
    )
    child = subprocess.Popen([sys.executable, "-c", script, str(path)])
    try:
        os.waitid(os.P_PID, child.pid, os.WSTOPPED)
        with pytest.raises(StoreInUse) as caught:
            SqliteJournal(path)
        assert caught.value.pid == child.pid
        with closing(SqliteJournal(path, takeover=True)):
            assert child.wait() == -signal.SIGKILL
    finally:
        child.kill()
        child.wait()


def test_a_dead_owner_holds_nothing_even_if_its_pid_lives_again(path: Path) -> None:
    child = spawn(path, "hold")
    assert (line(child), line(child)) == (b"open 1\n", b"held\n")
    child.kill()
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)  # a zombie: its pid exists, it does not
    SqliteJournal(path).close()
    end(child)
    row = (2, os.getpid(), "another boot:1", 3, 1)
    edit(path, f"UPDATE store SET pid = {row[1]}, start = '{row[2]}'")
    with closing(sqlite3.connect(path, isolation_level=None)) as db:
        floor, live = db.execute("SELECT floor, live FROM store").fetchone()
        db.execute("UPDATE store SET crc = ?", (crc_of(*row[:3], floor, live),))
    assert numbers(reopened(path)) == [1]


def test_of_many_openers_one_wins(path: Path) -> None:
    children = [spawn(path, "hold") for _ in range(5)]
    said = [line(child) for child in children]
    assert sorted(said) == [b""] * 4 + [b"open 1\n"]
    for child in children:
        end(child)


def test_an_owner_whose_epoch_is_stale_writes_nothing(store: SqliteJournal, path: Path) -> None:
    positions = store.append(inputs(2))
    store.cut(A, b"1", [], turn=1)
    epoch, *_, floor, live = store._store.claim.read()
    edit(path, f"UPDATE store SET epoch = 5, crc = {crc_of(5, 0, '', floor, live)}, pid = 0, start = ''")
    big = b"x" * (2 << 20)
    attempts: list[Callable[[], object]] = [
        lambda: store.append(inputs(1)),
        lambda: store.cut(A, b"2", positions, turn=2),
        lambda: store.cut(A, big, positions, turn=2),
        lambda: store.erase(A),
        lambda: store.note("key", b"value"),
        lambda: store.load(A),
    ]
    for attempt in attempts:
        with pytest.raises(StaleEpoch) as caught:
            attempt()
        assert caught.value.args == (str(path), epoch, 5)
    store.close()
    with closing(SqliteJournal(path)) as journal:
        assert journal.epoch == 6
        assert (journal.load(A).snapshot, numbers(journal.load(A))) == (b"1", [0, 1])
        assert journal.noted("key") is None
    assert os.listdir(f"{path}-snapshots") == []


def test_after_close_everything_is_refused(path: Path) -> None:
    journal = SqliteJournal(path)
    journal.close()
    for attempt in (lambda: journal.append(inputs(1)), lambda: journal.load(A), lambda: journal.noted("key")):
        with pytest.raises(StoreFailed, match="closed"):
            attempt()


# ---- kill -9


@pytest.mark.parametrize("seed", range(12))
def test_what_was_acknowledged_survives_kill_9(path: Path, seed: int) -> None:
    """Kill a writer at a random moment; each acknowledged batch is whole and in order, and no batch is half there."""
    choose = random.Random(seed)
    child = spawn(path, "write", seed)
    assert line(child) == b"open 1\n"
    assert child.stdout is not None
    select.select([child.stdout], [], [])
    threading.Event().wait(choose.uniform(0, 0.25))  # The moment is a matter of chance, whatever the seed.
    said = end(child).splitlines()
    acknowledged = max((int(word) for word in said if word.isdigit()), default=0)
    cuts = {int(words[1]): int(words[2]) for words in map(bytes.split, said) if words[0] == b"cut"}
    with closing(SqliteJournal(path)) as journal:
        assert journal.epoch == 2
        found: set[int] = set()
        upto = 0
        for owner in (0, 1):
            saved = journal.load(f"/{owner}")
            contained = int(saved.snapshot.split()[0]) if saved.snapshot else 0
            assert contained == saved.turn >= cuts.get(owner, 0)
            found |= {number for number in range(contained) if number % 2 == owner}
            found |= set(numbers(saved))
            assert numbers(saved) == sorted(set(numbers(saved)))
            assert all(number >= contained for number in numbers(saved))
            for _, entry in saved.entries:
                assert isinstance(entry[1], int)
                assert isinstance(entry[2], int)
                assert isinstance(entry[3], int)
                upto = max(upto, entry[1] - entry[3] + entry[2])  # where the batch of this entry ends
            upto = max(upto, contained)
        assert found == set(range(upto))
        assert upto >= acknowledged
        journal.append([("/0", ("in", upto))])
        assert numbers(journal.load("/0"))[-1:] == [upto]


# ---- damage


@pytest.fixture
def filled(path: Path) -> Path:
    """A closed store: two snapshots of A (one inline, one a file), three live entries; entries and a snapshot of B."""
    with closing(SqliteJournal(path)) as journal:
        positions = journal.append([*inputs(4), *inputs(4, B)])
        journal.cut(A, b"older", positions[:2], turn=2)
        positions += journal.append(inputs(2, start=4))
        journal.cut(A, b"newer" * 400_000, positions[:4], turn=4)
        journal.append([*inputs(1, start=6), *inputs(2, B, 4)])
        journal.cut(B, b"bob", [], turn=1)
        journal.note("key", b"value")
    return path


def contents(path: Path) -> tuple[Saved, Saved, bytes | None]:
    with closing(SqliteJournal(path)) as journal:
        return journal.load(A), journal.load(B), journal.noted("key")


def test_a_flipped_bit_in_an_entry_is_found(filled: Path) -> None:
    edit(filled, "UPDATE entries SET data = CAST(data || 'x' AS BLOB) WHERE position = 6")
    with closing(SqliteJournal(filled)) as journal:
        assert numbers(journal.load(A)) == [4, 5, 6]  # The others work.
        with pytest.raises(DamagedStore) as caught:
            journal.load(B)
        assert caught.value.args[:3] == (str(filled), B, 6)
        journal.erase(B)
    assert numbers(contents(filled)[1]) == []


def test_no_entry_goes_unmissed_not_even_the_last(filled: Path) -> None:
    intact = filled.read_bytes()
    with closing(sqlite3.connect(filled)) as db:
        positions = [position for (position,) in db.execute("SELECT position FROM entries")]
    assert len(positions) == 11
    for position in positions:
        filled.write_bytes(intact)
        edit(filled, f"DELETE FROM entries WHERE position = {position}")
        with pytest.raises(DamagedStore):
            contents(filled)


def test_a_hole_in_the_middle_is_located_and_leaves_others_alone(filled: Path) -> None:
    edit(filled, "DELETE FROM entries WHERE position = 6")
    with closing(SqliteJournal(filled)) as journal:
        assert numbers(journal.load(A)) == [4, 5, 6]
        for attempt in (
            lambda: journal.load(B),
            lambda: journal.append(inputs(1, B)),
            lambda: journal.cut(B, b"", [], turn=9),
        ):
            with pytest.raises(DamagedStore) as caught:
                attempt()
            assert caught.value.args[:3] == (str(filled), B, 7)
        journal.erase(B)
        journal.append(inputs(1, B))
    assert numbers(contents(filled)[1]) == [0]


@pytest.mark.parametrize(
    "statement",
    [
        "DELETE FROM entries WHERE address = 2",
        "UPDATE entries SET chain = chain + 1 WHERE position = 6",
        "UPDATE entries SET chain = NULL WHERE position = 6",
        "UPDATE entries SET address = 1 WHERE position = 6",
        "UPDATE entries SET address = 77 WHERE position = 6",
        "UPDATE entries SET position = 600 WHERE position = 6",
        "UPDATE entries SET kind = 'out' WHERE position = 6",
        "UPDATE entries SET crc = crc + 1 WHERE position = 6",
        "UPDATE entries SET data = NULL WHERE position = 6",
        "UPDATE entries SET data = CAST(x'ff' AS TEXT) WHERE position = 6",
        "UPDATE addresses SET path = '/c' WHERE id = 2",
        "UPDATE addresses SET removed = removed + 1 WHERE id = 2",
        "UPDATE addresses SET kept = '' WHERE id = 2",
        "DELETE FROM addresses WHERE id = 2",
        "UPDATE snapshots SET turn = 2 WHERE data = CAST('bob' AS BLOB)",
        "UPDATE snapshots SET data = CAST('rob' AS BLOB) WHERE data = CAST('bob' AS BLOB)",
        "DELETE FROM snapshots WHERE data = CAST('bob' AS BLOB)",
        "UPDATE notes SET value = CAST('values' AS BLOB)",
        "UPDATE notes SET name = 'other'",
        "UPDATE store SET epoch = 0",
        "UPDATE store SET live = live + 1",
        "DELETE FROM store",
        "PRAGMA user_version = 2",
        "PRAGMA application_id = 2",
        "ALTER TABLE entries ADD COLUMN more",
    ],
)
def test_damaged_rows_are_refused(filled: Path, statement: str) -> None:
    edit(filled, statement)
    with pytest.raises(DamagedStore):
        contents(filled)


@pytest.mark.parametrize("damage", ["flip", "truncate", "remove", "row"])
def test_a_damaged_snapshot_gives_way_to_the_older_one_with_all_entries_since(filled: Path, damage: str) -> None:
    (file,) = Path(f"{filled}-snapshots").iterdir()
    if damage == "flip":
        flip(file, 8_000_001)
    elif damage == "truncate":
        os.truncate(file, 1000)
    elif damage == "remove":
        file.unlink()
    else:
        edit(filled, "DELETE FROM snapshots WHERE turn = 4")
    saved = contents(filled)[0]
    assert (saved.snapshot, saved.turn, numbers(saved)) == (b"older", 2, [2, 3, 4, 5, 6])
    assert "snapshot" in saved.passed_over


def test_without_a_usable_snapshot_nothing_is_made_up(filled: Path) -> None:
    (file,) = Path(f"{filled}-snapshots").iterdir()
    file.unlink()
    edit(filled, "UPDATE snapshots SET data = CAST('oldest' AS BLOB) WHERE turn = 2")
    with closing(SqliteJournal(filled)) as journal:
        with pytest.raises(DamagedStore, match="no snapshot is left") as caught:
            journal.load(A)
        assert caught.value.address == A
        assert journal.load(B).snapshot == b"bob"


@pytest.mark.parametrize("size", [0, 50, 1000, 4096, 8192, 16384])
def test_a_truncated_file_is_refused(filled: Path, size: int) -> None:
    os.truncate(filled, size)
    with pytest.raises(DamagedStore):
        contents(filled)


def test_another_file_is_refused_and_left_alone(path: Path) -> None:
    edit(path, "CREATE TABLE mine(x)")
    before = path.read_bytes()
    with pytest.raises(DamagedStore, match="not a holdfast store"):
        SqliteJournal(path)
    path.with_name("text").write_text("some text " * 1000)
    with pytest.raises(DamagedStore):
        SqliteJournal(path.with_name("text"))
    assert path.read_bytes() == before


def killed(path: Path) -> bytes:
    """Let a child append one entry and kill it, so that the WAL stays; return the WAL."""
    child = spawn(path, "hold")
    assert (line(child), line(child)) == (b"open 1\n", b"held\n")
    end(child)
    return Path(f"{path}-wal").read_bytes()


def test_a_wal_that_lost_acknowledged_entries_is_refused(path: Path) -> None:
    """SQLite itself takes a flipped bit in the WAL for its end, and a missing WAL for an empty one."""
    wal = killed(path)
    flip(Path(f"{path}-wal"), 8 * len(wal) - 1000)
    with pytest.raises(DamagedStore, match="were acknowledged"):
        SqliteJournal(path)
    with pytest.raises(DamagedStore):  # It is refused again, until somebody decides.
        SqliteJournal(path)
    os.unlink(f"{path}-mark")
    assert numbers(reopened(path)) == []


def test_a_wal_without_its_database_is_refused(path: Path) -> None:
    killed(path)
    path.unlink()
    with pytest.raises(DamagedStore, match="-wal"):
        SqliteJournal(path)


def test_after_a_power_loss_a_torn_tail_is_cut(path: Path) -> None:
    wal = killed(path)
    flip(Path(f"{path}-wal"), 8 * len(wal) - 1000)
    mark = Path(f"{path}-mark")
    mark.write_bytes(mark.read_bytes()[:9] + b"another boot".ljust(36))
    assert numbers(reopened(path)) == []


@pytest.mark.parametrize("seed", range(4))
def test_no_flipped_bit_changes_what_is_read(filled: Path, tmp_path: Path, seed: int) -> None:
    """Flip random bits of the database: it is read as before, or refused, or an older snapshot says why."""
    choose = random.Random(seed)
    before = contents(filled)
    copy = tmp_path / "copy"
    for _ in range(25):
        shutil.rmtree(copy, ignore_errors=True)
        copy.mkdir()
        shutil.copytree(f"{filled}-snapshots", copy / "app.db-snapshots")
        shutil.copy(filled, copy)
        bit = choose.randrange(8 * filled.stat().st_size)
        flip(copy / "app.db", bit)
        try:
            after = contents(copy / "app.db")
        except (DamagedStore, StoreFailed):
            continue
        if after != before:
            assert any(saved.passed_over for saved in after[:2]), f"seed {seed}, bit {bit}"
