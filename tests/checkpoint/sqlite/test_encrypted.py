"""A store with a key keeps nothing that can be read without it, and takes nothing that was changed or moved."""

from __future__ import annotations

import os
import shutil
import sqlite3
import struct
import sys
import zlib
from collections.abc import Iterator
from contextlib import closing
from hashlib import blake2b
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.errors import StoreError
from holdfast.checkpoint.journal import DamagedStore, Saved, WrongStoreKey
from holdfast.checkpoint.sqlite import SqliteJournal, sealing
from holdfast.checkpoint.sqlite.row_codec import crc_of, row_crc
from holdfast.checkpoint.sqlite.sealing import StoreCipher
from holdfast.checkpoint.store_key import StoreKey, read_store_key
from tests.checkpoint.players import Doer, Note, Seen
from tests.checkpoint.sqlite.stores import KEY, A, B, edit, end, flip, inputs, line, made, numbers, reopened, spawn

SECRET = b"do not read this"
OTHER_KEY = bytes(32)
LARGE = SECRET * (1 << 17)
BLOCK = SECRET * 256
DIGESTS = [blake2b(A.encode(), digest_size=size).digest() for size in (8, 12, 16)]
WORDS = [SECRET, A.encode(), B.encode(), KEY, KEY.hex().encode(), *DIGESTS, *(one.hex().encode() for one in DIGESTS)]
"""What must not be seen in any file: contents, addresses and names, and what anybody could compute of these."""
Content = tuple[Saved, Saved, dict[str, bytes], bytes, bytes]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "store").mkdir()
    return tmp_path / "store" / "app.db"


def fill(journal: SqliteJournal) -> None:
    """Two entries and snapshots of A, one of them in a file; entries and an inline snapshot of B; packs and notes."""
    positions = journal.append([*inputs(4), *inputs(4, B), (A, ("in", 4, SECRET))])
    journal.cut(A, SECRET, positions[:1], turn=1)
    journal.cut(A, LARGE, positions[:2], turn=2)
    journal.cut(B, SECRET + b"!", [], turn=1)
    for number in (1, 2):
        journal.keep_blocks(A, number, [(0, memoryview(BLOCK)), (4096, memoryview(BLOCK))], number == 2)
    journal.note(f"note {SECRET.decode()}", SECRET)
    journal.note("other", b"")
    journal.append(inputs(1, B, start=4))


@pytest.fixture
def filled(path: Path) -> Path:
    """A closed store."""
    with closing(SqliteJournal(path, key=KEY)) as journal:
        fill(journal)
    return path


@pytest.fixture
def killed(filled: Path) -> Path:
    """The same after the death of an owner, with an entry in the log alone."""
    child = spawn(filled, "hold", key=KEY)
    assert [line(child), line(child)] == [b"open 2\n", b"held\n"]
    end(child)
    return filled


def content(path: Path) -> Content:
    with closing(SqliteJournal(path, key=KEY)) as journal:
        return journal.load(A), journal.load(B), journal.notes(""), block(journal, 1), block(journal, 2)


def block(journal: SqliteJournal, number: int) -> bytes:
    segment = journal.read_blocks(A, number, [(4096, len(BLOCK))])
    try:
        return bytes(segment.block(4096, len(BLOCK)))
    finally:
        segment.close()


def files(path: Path) -> dict[str, bytes]:
    """All files of a store; SQLite's index of the WAL is no data."""
    return {
        str(one): one.read_bytes() for one in path.parent.rglob("*") if one.is_file() and not one.name.endswith("-shm")
    }


def seen(path: Path) -> list[tuple[str, bytes]]:
    names = [(str(one), str(one.relative_to(path.parent)).encode()) for one in path.parent.rglob("*")]
    return [(name, word) for name, data in (*files(path).items(), *names) for word in WORDS if word in data]


def test_nothing_is_read_without_the_key(path: Path) -> None:
    """While it is open, as a kill leaves it, when it was closed, and when it was compacted."""
    with closing(SqliteJournal(path, key=KEY)) as journal:
        fill(journal)
        journal.in_hand.word(A)[0] = 1
        assert made(f"{path}-log"), "the log has something"
        assert Path(f"{path}-wal").stat().st_size
        assert not seen(path)
        copy = shutil.copytree(path.parent, path.parent.with_name("copy")) / path.name
        assert not seen(copy)
    assert not seen(path)
    with closing(SqliteJournal(path, key=KEY)) as journal:
        journal.erase(B)
        journal.compact()
        assert not seen(path)


async def test_a_system_keeps_nothing_that_can_be_read(path: Path) -> None:
    for life in (1, 2):
        async with hf.ActorSystem("app", store=f"sqlite:{path}", store_key=KEY, log=False) as system:
            secret = await system.start(hf.child("secret-name", hf.start(Doer), recovery=hf.hybrid()))
            await secret.ask(Note(SECRET.decode()))
            await system.checkpoint_group([secret], name="secret-group")
            assert await secret.ask(Seen()) == [SECRET.decode()] * life
            await system.backup(path.parent / f"backup{life}.db")
            data = b"".join(files(path).values())
            assert not [word for word in (SECRET, b"secret-", b"Note", b"Doer") if word in data]
        data = b"".join(files(path).values())
        assert not [word for word in (SECRET, b"secret-", b"Note", b"Doer") if word in data]
    with pytest.raises(WrongStoreKey):
        await hf.ActorSystem("app", store=f"sqlite:{path}", log=False).__aenter__()


# ---- keys


@pytest.mark.parametrize("key", [None, OTHER_KEY], ids=["no key", "another key"])
@pytest.mark.parametrize("state", ["filled", "killed"])
def test_another_key_is_refused_and_nothing_is_changed(
    request: pytest.FixtureRequest, state: str, key: bytes | None
) -> None:
    path = request.getfixturevalue(state)
    before = files(path)
    with pytest.raises(WrongStoreKey) as caught:
        SqliteJournal(path, key=key)
    assert caught.value.path == str(path)
    assert ("there is no key" in str(caught.value)) == (key is None)
    assert files(path) == before
    content(path)


def test_a_key_for_a_plain_store_is_refused_and_nothing_is_changed(path: Path) -> None:
    with closing(SqliteJournal(path)) as journal:
        journal.append(inputs(2))
    before = files(path)
    with pytest.raises(WrongStoreKey, match="it is not encrypted, and there is a key for it"):
        SqliteJournal(path, key=KEY)
    assert files(path) == before
    assert numbers(reopened(path)) == [0, 1]


def test_an_older_holdfast_refuses_the_format(path: Path) -> None:
    """It knows of 1 and 2."""
    with closing(SqliteJournal(path, key=KEY)), closing(sqlite3.connect(path)) as db:
        assert db.execute("PRAGMA user_version").fetchone() == (4,)
    with closing(sqlite3.connect(path)) as db:
        assert db.execute("PRAGMA user_version").fetchone() == (3,)
    edit(path, "DELETE FROM notes WHERE name = char(0) || 'key'")
    for key in (KEY, None):
        with pytest.raises(DamagedStore, match="whether it is encrypted"):
            SqliteJournal(path, key=key)


@pytest.mark.parametrize("data", [KEY, KEY.hex().encode(), KEY.hex().encode() + b"\n"])
def test_a_key_may_be_in_a_file(tmp_path: Path, data: bytes) -> None:
    file = tmp_path / "app.key"
    file.touch(mode=0o600)
    file.write_bytes(data)
    assert read_store_key(file) == read_store_key(str(file)) == read_store_key(lambda: KEY) == KEY
    file.chmod(0o640)
    with pytest.raises(hf.SpecError, match=r"others may use .*chmod 600"):
        read_store_key(file)


def test_a_file_that_is_no_key_is_not_to_be_closed_to_others(tmp_path: Path) -> None:
    file = tmp_path / "passwd"
    file.write_text("root:x:0:0:root:/root:/bin/sh\n")
    file.chmod(0o644)
    with pytest.raises(hf.SpecError, match=r"must have 32 bytes or 64 hex digits$"):
        read_store_key(file)


@pytest.mark.parametrize("key", [b"", KEY[:31], KEY + b"x", lambda: "x" * 32, lambda: KEY.hex().encode()])
def test_what_is_no_key_is_refused_and_not_shown(path: Path, key: StoreKey) -> None:
    with pytest.raises(hf.SpecError, match="must be 32 bytes") as caught:
        SqliteJournal(path, key=key)
    assert "\\x1e" not in str(caught.value)
    assert KEY.hex() not in str(caught.value)
    assert not list(path.parent.iterdir())


@pytest.mark.parametrize("data", [b"", KEY[:31], KEY.hex().encode()[:-1], b"x" * 64, KEY.hex().encode() * 2])
def test_a_file_without_a_key_is_refused(tmp_path: Path, data: bytes) -> None:
    file = tmp_path / "app.key"
    file.touch(mode=0o600)
    file.write_bytes(data)
    with pytest.raises(hf.SpecError, match="32 bytes or 64 hex digits"):
        read_store_key(file)
    with pytest.raises(hf.SpecError, match="cannot be read"):
        read_store_key(tmp_path / "missing")


@pytest.mark.parametrize("store", [None, "memory"])
def test_a_key_needs_a_store_on_the_disk(store: str | None) -> None:
    with pytest.raises(hf.SpecError, match="store_key needs a store on the disk"):
        hf.ActorSystem("app", store=store, store_key=KEY)


def test_a_key_is_in_no_representation(path: Path) -> None:
    system = hf.ActorSystem("app", store=f"sqlite:{path}", store_key=KEY)
    assert "store_key" not in repr(system._options)


def test_without_the_library_it_is_said_what_to_install(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cryptography.hazmat.primitives.ciphers.aead", None)
    with pytest.raises(hf.SpecError, match=r"holdfast\[crypto\]"):
        SqliteJournal(path, key=KEY)
    assert not path.exists()


# ---- changes


def test_each_byte_of_what_is_kept_in_rows_counts(filled: Path) -> None:
    """Whoever changes it can mend the checksum of an entry, but not its tag."""
    good = content(filled)
    with closing(sqlite3.connect(filled)) as db:
        rows = db.execute("SELECT position, address, chain, data FROM entries WHERE address = 2").fetchall()
        (drops,) = db.execute("SELECT drops FROM snapshots WHERE id = 2").fetchone()
        (inline,) = db.execute("SELECT data FROM snapshots WHERE id = 3").fetchone()
        (path,) = db.execute("SELECT path FROM addresses WHERE id = 1").fetchone()
    position, address, number, data = rows[-1]
    intact = filled.read_bytes()

    def refused(statement: str, *values: Any) -> None:
        filled.write_bytes(intact)
        with closing(sqlite3.connect(filled, isolation_level=None)) as db:
            db.execute(statement, values)
        with pytest.raises(DamagedStore):
            content(filled)

    for at in range(len(data)):
        changed = bytearray(data)
        changed[at] ^= 1
        crc = row_crc(position, address, number, bytes(changed))
        refused("UPDATE entries SET data = ?, crc = ? WHERE position = ?", bytes(changed), crc, position)
    for column, one, value in (("drops", 2, drops), ("data", 3, inline)):
        for at in range(0, len(value), 3):
            changed = bytearray(value)
            changed[at] ^= 1
            filled.write_bytes(intact)
            with closing(sqlite3.connect(filled, isolation_level=None)) as db:
                db.execute(f"UPDATE snapshots SET {column} = ? WHERE id = ?", (bytes(changed), one))
            try:
                assert content(filled)[0].passed_over, "an older snapshot takes its place, and that is told"
            except DamagedStore:
                assert one == 3, "there is no older one"
    for value in (b"", b"x", path[:-1], None, "/c"):
        refused("UPDATE addresses SET path = ? WHERE id = 1", value)
    filled.write_bytes(intact)
    assert content(filled) == good


def test_each_byte_of_the_files_counts(killed: Path) -> None:
    """Of snapshots and packs, of the log, and of the database: what is read is right, or refused, or told of."""
    copies = iter(range(1 << 20))

    def copied() -> Path:
        return shutil.copytree(killed.parent, killed.parent.with_name(f"copy{next(copies)}")) / killed.name

    good = content(copied())
    checked = 0
    for name, data in files(killed).items():
        if name.endswith(("-mark", "-hands", "store-id")):
            continue
        bits = 8 * len(data)
        for bit in range(5, bits, max(8 * 7 + 1, bits // 60)):
            one = copied()
            flip(one.parent / Path(name).relative_to(killed.parent), bit)
            checked += 1
            try:
                found = content(one)
            except StoreError:
                continue
            finally:
                shutil.rmtree(one.parent)
            if found[0].passed_over:
                assert found[0].snapshot == SECRET
            else:
                assert found == good, f"{name}, bit {bit}"
    assert checked > 200


def swap(path: Path, table: str, column: str, key: str, first: int, second: int) -> None:
    """Swap two values, and mend the checksums that anybody can make."""
    with closing(sqlite3.connect(path, isolation_level=None)) as db:
        values = [
            db.execute(f"SELECT {column} FROM {table} WHERE {key} = ?", (one,)).fetchone() for one in (first, second)
        ]
        for one, (value,) in zip((second, first), values, strict=True):
            db.execute(f"UPDATE {table} SET {column} = ? WHERE {key} = ?", (value, one))
        for position, address, number, data in db.execute(
            "SELECT position, address, chain, data FROM entries"
        ).fetchall():
            crc = row_crc(position, address, number, data)
            db.execute("UPDATE entries SET crc = ? WHERE position = ?", (crc, position))


@pytest.mark.parametrize(
    ("table", "column", "key", "first", "second"),
    [
        ("entries", "data", "position", 5, 6),
        ("entries", "data", "position", 3, 5),
        ("entries", "address", "position", 4, 5),
        ("snapshots", "data", "id", 1, 3),
        ("snapshots", "turn", "id", 1, 2),
        ("addresses", "path", "id", 1, 2),
        ("addresses", "kept", "id", 1, 2),
        ("notes", "value", "key", 4, 5),
        ("notes", "name", "key", 4, 5),
    ],
)
def test_what_was_moved_to_another_place_is_refused(
    filled: Path, table: str, column: str, key: str, first: int, second: int
) -> None:
    good = content(filled)
    swap(filled, table, column, key, first, second)
    try:
        found = content(filled)
    except DamagedStore:
        return
    assert found[0].passed_over, "an older snapshot takes its place, and that is told"
    assert found[1:] == good[1:]


def test_a_list_of_what_a_snapshot_contains_is_bound_to_it(filled: Path) -> None:
    swap(filled, "snapshots", "drops", "id", 1, 2)
    with pytest.raises(DamagedStore):
        content(filled)
    edit(filled, "UPDATE snapshots SET drops = x'' WHERE id < 3")  # All that it contains would be handled again.
    with pytest.raises(DamagedStore):
        content(filled)


def test_files_that_were_swapped_are_refused(path: Path) -> None:
    with closing(SqliteJournal(path, key=KEY)) as journal:
        fill(journal)
        journal.cut(B, LARGE + b"!", [], turn=2)
        journal.keep_blocks(B, 1, [(0, memoryview(BLOCK)), (4096, memoryview(BLOCK[:-1] + b"?"))], False)
    packs = [*Path(f"{path}-packs").rglob("1.pack"), *Path(f"{path}-packs").rglob("2.pack")]
    for first, second in (made(f"{path}-snapshots"), packs[:2], packs[1:]):
        one, other = first.read_bytes(), second.read_bytes()
        first.write_bytes(other)
        second.write_bytes(one)
        try:
            assert content(path)[0].passed_over
        except DamagedStore:
            pass
        first.write_bytes(one)
        second.write_bytes(other)
    assert content(path)[3] == BLOCK


def test_blocks_that_were_swapped_within_a_pack_are_refused(filled: Path) -> None:
    """With the checksums mended, which anybody can make."""
    (pack,) = Path(f"{filled}-packs").rglob("1.pack")
    data = pack.read_bytes()
    size = (len(data) - 8) // 2
    heads, kept = zip(*((data[at : at + 20], data[at + 24 : at + size]) for at in (8, 8 + size)), strict=True)
    swapped = [
        head + struct.pack("<I", zlib.crc32(one, zlib.crc32(head))) + one
        for head, one in zip(heads, reversed(kept), strict=True)
    ]
    pack.write_bytes(data[:8] + b"".join(swapped))
    with pytest.raises(DamagedStore, match="its tag is wrong"):
        content(filled)


def test_rows_of_another_store_with_the_same_key_are_refused(filled: Path, tmp_path: Path) -> None:
    other = tmp_path / "other" / "app.db"
    other.parent.mkdir()
    with closing(SqliteJournal(other, key=KEY)) as journal:
        fill(journal)
    query = "SELECT position, data, crc FROM entries WHERE address = 2"
    with closing(sqlite3.connect(other)) as source, closing(sqlite3.connect(filled, isolation_level=None)) as db:
        for position, data, crc in source.execute(query):
            db.execute("UPDATE entries SET data = ?, crc = ? WHERE position = ?", (data, crc, position))
    with pytest.raises(DamagedStore):
        content(filled)
    shutil.rmtree(f"{filled}-packs")
    shutil.copytree(f"{other}-packs", f"{filled}-packs")
    shutil.copy(Path(f"{filled}-snapshots", "store-id"), f"{filled}-packs")
    with closing(SqliteJournal(filled, key=KEY)) as journal, pytest.raises(DamagedStore):
        journal.read_blocks(A, 1, [(0, len(BLOCK))])


@pytest.mark.parametrize(
    ("table", "columns", "statements"),
    [
        (
            "addresses",
            "id, path, removed, removed_sum, floor, kept",
            [
                "DELETE FROM entries WHERE position = 5",
                "UPDATE addresses SET removed = 1, removed_sum = 1 WHERE id = 2",
            ],
        ),
        (
            "store",
            "epoch, pid, start, floor, live",
            ["DELETE FROM entries WHERE position = 15", "UPDATE store SET live = live - 1"],
        ),
        ("notes", "name, value", ["UPDATE notes SET value = x'00' WHERE key = 4"]),
    ],
)
def test_a_checksum_is_not_made_without_the_key(filled: Path, table: str, columns: str, statements: list[str]) -> None:
    """Entries would be gone, and the counts that miss them would say that all is well."""
    edit(filled, *statements)
    with closing(sqlite3.connect(filled, isolation_level=None)) as db:
        for number, *fields in db.execute(f"SELECT rowid, {columns} FROM {table}").fetchall():
            db.execute(f"UPDATE {table} SET crc = ? WHERE rowid = ?", (crc_of(*fields), number))
    with pytest.raises(DamagedStore, match=r"checksum|key of the store"):
        content(filled)


# ---- the cipher


def sealed_in(path: Path) -> Iterator[bytes]:
    """All that is sealed in the rows of a store."""
    with closing(sqlite3.connect(path)) as db:
        for query in (
            "SELECT data FROM entries",
            "SELECT path FROM addresses",
            "SELECT drops FROM snapshots",
            "SELECT data FROM snapshots WHERE data NOT NULL",
            "SELECT value FROM notes WHERE length(value) > 17",
        ):
            yield from (value for (value,) in db.execute(query))


def test_no_key_and_number_come_together_twice(filled: Path) -> None:
    """Not in several openings, and not in copies of the files that go different ways."""
    copy = shutil.copytree(filled.parent, filled.parent.with_name("copy")) / filled.name
    heads: list[tuple[bytes, bytes]] = []
    for path in (filled, copy):
        for _ in range(2):
            with closing(SqliteJournal(path, key=KEY)) as journal:
                journal.append(inputs(30, B, start=100))
                journal.note("more", SECRET)
        for one in sealed_in(path):
            at = 4 if one[:2] == b"\x92\xa0" else 0  # An entry is packed.
            heads.append((one[at : at + 24], one))
    assert len({head for head, _ in heads}) == len(set(heads))
    assert len(set(heads)) > 130


@pytest.mark.parametrize("size", [0, 1, (1 << 20) - 1, 1 << 20, (1 << 20) + 1, 3 << 20])
def test_pieces_are_neither_left_out_nor_swapped_nor_cut(size: int) -> None:
    cipher = StoreCipher(KEY, bytes(16))
    data = os.urandom(size)
    kept = bytes(cipher.seal(b"place", data))
    assert kept == b"".join(map(bytes, (kept,)))
    assert cipher.unseal(b"place", kept) == data
    assert cipher.unseal(b"place", b"".join(cipher.sealed_parts(b"place", data))) == data
    assert StoreCipher(KEY, bytes(16)).unseal(b"place", kept) == data
    head, piece = 24, (1 << 20) + 16
    pieces = [kept[at : at + piece] for at in range(head, len(kept), piece)]
    wrong = [kept[:-1], kept[:-piece], kept + b"x", kept[:head], b"".join((kept[:head], *pieces[::-1]))]
    wrong += [b"".join((kept[:head], *pieces[:-1])), b"".join((kept[:head], *pieces, *pieces))]
    for one in wrong:
        if one != kept:
            with pytest.raises(ValueError, match=r"sealed|tag"):
                cipher.unseal(b"place", one)
    for other, place in (
        (cipher, b"other"),
        (StoreCipher(KEY, b"x" * 16), b"place"),
        (StoreCipher(OTHER_KEY, bytes(16)), b"place"),
    ):
        with pytest.raises(ValueError, match="its tag is wrong"):
            other.unseal(place, kept)


def test_a_plain_store_is_what_it_was(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing of the cipher is made without a key."""

    def fail(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr(sealing, "StoreCipher", fail)
    with closing(SqliteJournal(path)) as journal:
        fill(journal)
    with closing(sqlite3.connect(path)) as db:
        assert db.execute("PRAGMA user_version").fetchone() == (1,)
        assert db.execute("SELECT kind FROM entries LIMIT 1").fetchone() == ("in",)
