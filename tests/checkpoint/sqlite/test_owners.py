"""The store has one owner at a time, and what was acknowledged to it survives its death."""

from __future__ import annotations

import os
import random
import select
import signal
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from holdfast.checkpoint.journal import (
    StaleEpoch,
    StoreFailed,
    StoreInUse,
)
from holdfast.checkpoint.sqlite import SqliteJournal, database
from holdfast.checkpoint.sqlite.row_codec import crc_of
from tests.checkpoint.sqlite.stores import KEY, A, disown, edit, end, inputs, line, made, numbers, reopened, spawn

pytestmark = pytest.mark.usefixtures("warm_programs")


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
            assert (caught.value.path, caught.value.pid) == (str(path), os.getpid())
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


@pytest.mark.parametrize("step", ["create_tables", "new_notes", "sync", "os.link"])
def test_whoever_makes_the_store_first_may_sweep_what_another_one_makes(
    path: Path, step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two programs open a store that is not there yet, and one is overtaken at each step of making it."""
    name = step if step.startswith("os.") else f"holdfast.checkpoint.sqlite.database.{step}"
    right = os.link if step == "os.link" else getattr(database, step)
    overtaken: list[int] = []

    def overtake() -> None:
        with closing(SqliteJournal(path)) as journal:
            overtaken.append(journal.epoch)

    def slow(*arguments: Any) -> Any:
        monkeypatch.setattr(name, right)
        other = threading.Thread(target=overtake)
        other.start()
        other.join()
        return right(*arguments)

    monkeypatch.setattr(name, slow)
    with closing(SqliteJournal(path)) as journal:
        assert (overtaken, journal.epoch) == ([1], 2)


def test_an_owner_whose_epoch_is_stale_writes_nothing(store: SqliteJournal, path: Path) -> None:
    positions = store.append(inputs(2))
    store.cut(A, b"1", [], turn=1)
    disown(path)
    SqliteJournal(path).close()
    big = b"x" * (2 << 20)
    attempts: list[Callable[[], object]] = [
        lambda: store.append(inputs(1)),
        lambda: store.append(inputs(400)),
        lambda: store.cut(A, b"2", positions, turn=2),
        lambda: store.cut(A, big, positions, turn=2),
        lambda: store.erase(A),
        lambda: store.note("key", b"value"),
        lambda: store.load(A),
    ]
    for attempt in attempts:
        with pytest.raises(StaleEpoch) as caught:
            attempt()
        assert (caught.value.path, caught.value.epoch, caught.value.current) == (str(path), 1, 2)
    store.close()
    with closing(SqliteJournal(path)) as journal:
        assert journal.epoch == 3
        assert (journal.load(A).snapshot, numbers(journal.load(A))) == (b"1", [0, 1])
        assert journal.noted("key") is None
    assert made(f"{path}-snapshots") == []


def test_after_close_everything_is_refused(path: Path) -> None:
    journal = SqliteJournal(path)
    journal.close()
    for attempt in (lambda: journal.append(inputs(1)), lambda: journal.load(A), lambda: journal.noted("key")):
        with pytest.raises(StoreFailed, match="closed"):
            attempt()


@pytest.mark.parametrize(("seed", "key"), [*((seed, None) for seed in range(12)), *((seed, KEY) for seed in range(6))])
def test_what_was_acknowledged_survives_kill_9(path: Path, seed: int, key: bytes | None) -> None:
    """Kill a writer at a random moment; each acknowledged batch is whole and in order, and no batch is half there."""
    choose = random.Random(seed)
    child = spawn(path, "write", seed, key)
    assert line(child) == b"open 1\n"
    assert child.stdout is not None
    select.select([child.stdout], [], [])
    threading.Event().wait(choose.uniform(0, 0.25))  # The moment is a matter of chance, whatever the seed.
    said = end(child).splitlines()
    acknowledged = max((int(word) for word in said if word.isdigit()), default=0)
    cuts = {int(words[1]): int(words[2]) for words in map(bytes.split, said) if words[0] == b"cut"}
    with closing(SqliteJournal(path, key=key)) as journal:
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
