"""The tools on stores with a key: nothing comes out in plain text but what is asked for, and a key can be changed."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from holdfast.checkpoint.journal import DamagedStore, WrongStoreKey
from holdfast.checkpoint.sqlite import SqliteJournal
from holdfast.checkpoint.store_tools import (
    NotCopied,
    back_up_store,
    compact_store,
    export_store,
    rekey_store,
    restore_store,
    store_stats,
    verify_store,
)
from tests.checkpoint.sqlite.stores import KEY, A, B, edit, end, inputs, numbers
from tests.checkpoint.store_tools.writing import (
    acknowledged,
    begin_writing,
    contents,
    count_numbers,
    everything,
    filled,
    killed_at_each_step,
    run,
)

OTHER_KEY = bytes(32)
PLAIN = (b"newer", b"older", b"block", A.encode(), B.encode())
"""What would be in the files of a plain store."""


def key_file(folder: Path, key: bytes = KEY) -> Path:
    file = folder / f"{key[1]}.key"
    file.touch(mode=0o600)
    file.write_text(key.hex() + "\n")
    return file


def is_readable(folder: Path) -> bool:
    return any(word in data for data, *_ in everything(folder).values() for word in PLAIN)


@pytest.mark.parametrize("command", ["verify", "stats", "export", "backup", "restore", "compact"])
def test_each_command_needs_the_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str) -> None:
    path, right, wrong = filled(tmp_path / "store" / "app.db", KEY), key_file(tmp_path), key_file(tmp_path, OTHER_KEY)
    rest = [tmp_path / "copy.db"] if command in ("backup", "restore") else []
    before = everything(path.parent)
    for options in ([], ["--key-file", wrong], ["--key-file", tmp_path / "nothing"]):
        status, _, complaint = run(command, path, *rest, *options)
        assert status == 2, complaint
        assert "key" in complaint
    assert everything(path.parent) == before
    assert not any(one.exists() for one in rest)
    status, said, complaint = run(command, path, *rest, "--key-file", right)
    assert status == 0, complaint
    assert (A in said) == (command in ("stats", "export"))
    for one in rest:
        one.unlink()
        assert not is_readable(path.parent)
    monkeypatch.setenv("HOLDFAST_STORE_KEY_FILE", str(right))
    assert run("verify", path)[0] == 0


def test_the_tools_tell_of_an_encrypted_store_what_they_tell_of_a_plain_one(tmp_path: Path) -> None:
    plain, sealed = filled(tmp_path / "plain" / "app.db"), filled(tmp_path / "sealed" / "app.db", KEY)
    found, sealed_found = verify_store(plain), verify_store(sealed, key=KEY)
    assert sealed_found.is_good
    assert [getattr(found, one) for one in ("last", "entries", "snapshots", "packs")] == [
        getattr(sealed_found, one) for one in ("last", "entries", "snapshots", "packs")
    ]
    assert [one.address for one in store_stats(sealed, key=KEY).addresses] == [A, B]
    assert store_stats(sealed, key=KEY).version == 3
    assert list(export_store(plain))[1:] == list(export_store(sealed, key=KEY))[1:]
    compact_store(sealed, key=KEY)
    assert contents(sealed, KEY) == contents(plain)


def test_a_backup_is_encrypted_and_apart_from_its_origin(tmp_path: Path) -> None:
    path, backup, again = filled(tmp_path / "store" / "app.db", KEY), tmp_path / "backup.db", tmp_path / "again.db"
    copy = back_up_store(path, backup, key=KEY)
    assert verify_store(backup, key=KEY).identity == copy.identity
    restore_store(backup, again, key=KEY)
    assert contents(path, KEY) == contents(backup, KEY) == contents(again, KEY)
    assert not is_readable(tmp_path)
    with pytest.raises(WrongStoreKey):
        restore_store(backup, tmp_path / "other.db", key=OTHER_KEY)
    with closing(sqlite3.connect(backup)) as source, closing(sqlite3.connect(path, isolation_level=None)) as db:
        for position, data, crc in source.execute("SELECT position, data, crc FROM entries").fetchall():
            db.execute("UPDATE entries SET data = ?, crc = ? WHERE position = ?", (data, crc, position))
    with closing(SqliteJournal(path, key=KEY)) as journal, pytest.raises(DamagedStore):
        journal.load(A)


def test_no_number_is_given_twice_in_a_copy(tmp_path: Path) -> None:
    """Numbers of addresses and snapshots that are gone are places of what is sealed."""
    path = filled(tmp_path / "app.db", KEY)
    with closing(SqliteJournal(path, key=KEY)) as journal:
        journal.erase(B)
    back_up_store(path, tmp_path / "copy.db", key=KEY)
    for one in (path, tmp_path / "copy.db"):
        with closing(SqliteJournal(one, key=KEY)) as journal:
            journal.append(inputs(1, B))
        with closing(sqlite3.connect(one)) as db:
            assert db.execute("SELECT max(id) FROM addresses").fetchone() == (3,)


@pytest.mark.parametrize(("key", "new_key"), [(None, KEY), (KEY, OTHER_KEY), (KEY, None)])
def test_a_key_is_changed_by_a_copy(tmp_path: Path, key: bytes | None, new_key: bytes | None) -> None:
    path, dest = filled(tmp_path / "store" / "app.db", key), tmp_path / "new" / "app.db"
    dest.parent.mkdir()
    before = everything(path.parent)
    options = ["--key-file", key_file(tmp_path, key)] if key else []
    options += ["--new-key-file", key_file(tmp_path, new_key)] if new_key else ["--plain"]
    assert run("rekey", path, dest, *options)[0] == 0
    assert everything(path.parent) == before
    assert is_readable(dest.parent) == (new_key is None)
    assert verify_store(dest, key=new_key).is_good
    assert contents(dest, new_key) == contents(path, key)
    assert contents(path, key), "and the old one is there"
    with pytest.raises(WrongStoreKey):
        SqliteJournal(dest, key=key)


def test_a_store_whose_key_is_changed_is_closed_and_good_and_nothing_is_in_the_way(tmp_path: Path) -> None:
    path, dest = filled(tmp_path / "app.db", KEY), tmp_path / "new.db"
    assert run("rekey", path, dest, "--key-file", key_file(tmp_path))[0] == 2, "a plain copy must be asked for"
    with closing(SqliteJournal(path, key=KEY)), pytest.raises(NotCopied, match="has it open"):
        rekey_store(path, dest, key=KEY, new_key=OTHER_KEY)
    dest.touch()
    with pytest.raises(NotCopied, match="nothing is overwritten"):
        rekey_store(path, dest, key=KEY, new_key=OTHER_KEY)
    dest.unlink()
    edit(path, "UPDATE entries SET crc = crc + 1 WHERE position = 6")
    with pytest.raises(NotCopied, match="the store is damaged"):
        rekey_store(path, dest, key=KEY, new_key=OTHER_KEY)
    assert not list(tmp_path.glob("new.db*"))


def test_what_is_damaged_is_damaged_in_the_copy(tmp_path: Path) -> None:
    path = filled(tmp_path / "app.db", KEY)
    (pack,) = Path(f"{path}-packs").rglob("*.pack")
    for number, statement in enumerate(
        (
            "UPDATE entries SET crc = crc + 1 WHERE position = 6",
            "UPDATE entries SET data = zeroblob(60) WHERE position = 6",
            "UPDATE snapshots SET drops = x'' WHERE id = 1",
            "UPDATE snapshots SET digest = x'00' WHERE id = 3",
            "UPDATE notes SET value = x'00' WHERE name != char(0) || 'key' AND length(value) > 17",
            "UPDATE addresses SET kept = '' WHERE id = 1",
        )
    ):
        intact, dest = path.read_bytes(), tmp_path / f"copy{number}.db"
        edit(path, statement)
        back_up_store(path, dest, key=KEY)
        path.write_bytes(intact)
        assert not verify_store(dest, key=KEY).is_good, statement
    for file in (pack, *Path(f"{path}-snapshots").glob("*.snapshot")):
        data = file.read_bytes()
        file.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
        dest = tmp_path / f"{file.name}.db"
        back_up_store(path, dest, key=KEY)
        file.write_bytes(data)
        assert not verify_store(dest, key=KEY).is_good
    assert verify_store(path, key=KEY).is_good


def test_a_copy_of_an_encrypted_store_that_is_written_to_is_of_one_instant(tmp_path: Path) -> None:
    path = tmp_path / "app.db"
    writer = begin_writing(path, 1, key=KEY)
    try:
        for number in range(3):
            least = acknowledged(writer, 200 * (number + 1))
            copy = tmp_path / f"copy{number}.db"
            back_up_store(path, copy, key=KEY)
            assert verify_store(copy, key=KEY).is_good
            assert count_numbers(copy, KEY) >= least
    finally:
        end(writer)
    assert verify_store(path, key=KEY).is_good


def test_a_kill_at_each_step_leaves_no_half_copy_and_nothing_readable(tmp_path: Path) -> None:
    folder = tmp_path / "disk"
    path, dest = filled(folder / "app.db", KEY), folder / "copy.db"
    killed = code = 0
    for _, code in killed_at_each_step(
        tmp_path, folder, f"back_up_store({str(path)!r}, {str(dest)!r}, key=bytes(range(32)))"
    ):
        assert code in (0, -signal.SIGKILL)
        killed += code != 0
        assert not is_readable(folder)
        if dest.exists():
            assert verify_store(dest, key=KEY).is_good
        for one in folder.glob("copy.db*"):
            if code and one.is_dir():
                for file in sorted(one.rglob("*"), reverse=True):
                    os.rmdir(file) if file.is_dir() else os.unlink(file)
                one.rmdir()
            elif code:
                one.unlink()
    assert (code, killed > 5) == (0, True)
    assert contents(dest, KEY) == contents(path, KEY)


def test_an_export_of_a_killed_store_has_what_is_in_the_log(tmp_path: Path) -> None:
    path = filled(tmp_path / "app.db", KEY)
    with closing(SqliteJournal(path, key=KEY)) as journal:
        journal.append(inputs(1, start=77))
        found = [json.dumps(record) for record in export_store(path, key=KEY)]
        assert any('"input": 77' in record or "[77]" in record or "77" in record for record in found)
        assert numbers(journal.load(A))[-1] == 77
