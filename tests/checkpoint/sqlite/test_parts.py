"""A store is opened only if all its parts are its own; what is refused is left exactly as it was."""

from __future__ import annotations

import contextlib
import os
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

import holdfast as hf
from holdfast.checkpoint.journal import DamagedStore, ForeignStore, StoreFailed, StoreInUse
from holdfast.checkpoint.sqlite import SqliteJournal, open_store
from holdfast.checkpoint.sqlite.row_codec import crc_of
from holdfast.checkpoint.sqlite.store_parts import NOTE
from tests.checkpoint.players import Doer, Note, Seen
from tests.checkpoint.sqlite.stores import A, disown, end, inputs, line, made, numbers, reopened, spawn

LARGE = b"x" * (2 << 20)


def filled(path: Path) -> Path:
    """A closed store with entries and a snapshot in a file of its own."""
    path.parent.mkdir(exist_ok=True)
    with closing(SqliteJournal(path)) as journal:
        positions = journal.append(inputs(3))
        journal.cut(A, LARGE, positions[:1], turn=1)
    return path


def made_in(folder: Path) -> Path:
    """The path of a store in a new folder."""
    folder.mkdir()
    return folder / "app.db"


def killed(path: Path) -> Path:
    """The same as a kill of its owner leaves it, with entries in the log alone."""
    child = spawn(path, "hold")
    assert [line(child), line(child)] == [b"open 1\n", b"held\n"]
    end(child)
    return path


def content(folder: Path) -> dict[str, tuple[bytes, int]]:
    """All files of a folder, byte by byte; SQLite's index of the WAL is no data."""
    return {
        str(one.relative_to(folder)): (one.read_bytes(), one.lstat().st_mode)
        for one in folder.rglob("*")
        if one.is_file() and not one.name.endswith("-shm")
    }


def remove(path: Path) -> None:
    shutil.rmtree(path) if path.is_dir() else path.unlink()


def replace(path: Path, other: Path) -> None:
    """Put another store's part in the place of this one's."""
    remove(path)
    shutil.copytree(other, path) if other.is_dir() else shutil.copy(other, path)


def loses_its_database(path: Path) -> None:
    path.unlink()


def gets_another_database(path: Path) -> None:
    replace(path, filled(path.parent.parent / "other" / "app.db"))


def gets_other_snapshots(path: Path) -> None:
    replace(Path(f"{path}-snapshots"), Path(f"{filled(path.parent.parent / 'other' / 'app.db')}-snapshots"))


def gets_another_log(path: Path) -> None:
    replace(Path(f"{path}-log"), Path(f"{filled(path.parent.parent / 'other' / 'app.db')}-log"))


def loses_the_identity_of_its_snapshots(path: Path) -> None:
    Path(f"{path}-snapshots", "store-id").unlink()
    Path(f"{path}-snapshots", "1-1.snapshot").touch()


def gets_another_name(path: Path) -> None:
    os.link(path, path.with_name("other.db"))


def is_open_to_others(path: Path) -> None:
    path.chmod(0o666)


def has_a_folder_that_is_open_to_others(path: Path) -> None:
    Path(f"{path}-log").chmod(0o770)


def has_a_link_for_a_folder(path: Path) -> None:
    folder = Path(f"{path}-snapshots")
    folder.rename(folder.with_name("elsewhere"))
    folder.symlink_to("elsewhere")


def has_a_link_for_its_mark(path: Path) -> None:
    path.with_name("victim").write_text("precious")
    mark = Path(f"{path}-mark")
    mark.unlink(missing_ok=True)
    mark.symlink_to("victim")


def is_of_another_user(path: Path) -> None:
    if os.geteuid():
        pytest.skip("only root can give a file away")
    os.chown(path, 12345, -1)


@pytest.mark.parametrize("life", [filled, killed])
@pytest.mark.parametrize(
    "it",
    [
        loses_its_database,
        gets_another_database,
        gets_other_snapshots,
        gets_another_log,
        loses_the_identity_of_its_snapshots,
        gets_another_name,
        is_open_to_others,
        has_a_folder_that_is_open_to_others,
        has_a_link_for_a_folder,
        has_a_link_for_its_mark,
        is_of_another_user,
    ],
)
def test_what_does_not_belong_together_is_refused_and_left_as_it_is(
    tmp_path: Path, life: Callable[[Path], Path], it: Callable[[Path], None]
) -> None:
    (tmp_path / "store").mkdir()
    path = life(tmp_path / "store" / "app.db")
    it(path)
    before = content(path.parent)
    with pytest.raises(ForeignStore) as caught:
        SqliteJournal(path)
    assert content(path.parent) == before
    assert caught.value.path == str(path)
    assert caught.value.part.startswith(str(path))
    assert caught.value.remedy


def test_a_database_that_is_put_back_is_opened_again(tmp_path: Path) -> None:
    path = filled(tmp_path / "app.db")
    path.rename(tmp_path / "away.db")
    with pytest.raises(ForeignStore, match=r"the database is gone, but app\.db-snapshots, app\.db-log"):
        SqliteJournal(path)
    (tmp_path / "away.db").rename(path)
    saved = reopened(path)
    assert (saved.snapshot, numbers(saved)) == (LARGE, [1, 2])


def test_a_linked_database_of_a_living_owner_is_not_opened_under_its_other_name(tmp_path: Path) -> None:
    with closing(SqliteJournal(tmp_path / "app.db")) as journal:
        journal.append(inputs(2))
        os.link(tmp_path / "app.db", tmp_path / "other.db")
        with pytest.raises(ForeignStore, match="2 names"):
            SqliteJournal(tmp_path / "other.db")
        (tmp_path / "other.db").unlink()
        journal.append(inputs(1, start=2))
    assert numbers(reopened(tmp_path / "app.db")) == [0, 1, 2]


def test_a_copy_of_what_a_living_owner_has_open_is_refused_and_the_owner_lives_on(tmp_path: Path) -> None:
    """Not even a takeover is meant for the owner of other files. When that has ended, it is like one of a kill."""
    path = made_in(tmp_path / "a")
    child = spawn(path, "hold")
    try:
        assert [line(child), line(child)] == [b"open 1\n", b"held\n"]
        copy = shutil.copytree(path.parent, tmp_path / "b") / path.name
        before = content(copy.parent)
        for takeover in (False, True):
            with pytest.raises(ForeignStore, match=f"a copy of a store that process {child.pid} has open"):
                SqliteJournal(copy, takeover=takeover)
        assert content(copy.parent) == before
        assert child.poll() is None
        with pytest.raises(StoreInUse):
            SqliteJournal(path)
        path.rename(path.with_name("moved"))  # The same file under another name is no copy.
        path.with_name("moved").rename(path)
        with pytest.raises(StoreInUse):
            SqliteJournal(path)
    finally:
        end(child)
    assert numbers(reopened(copy)) == numbers(reopened(path)) == [1]


def test_a_living_owner_that_nobody_sees_has_the_lock(tmp_path: Path) -> None:
    """Its row says that it is dead, as it seems from a container with process ids of its own."""
    path = tmp_path / "app.db"
    child = spawn(path, "hold")
    try:
        assert [line(child), line(child)] == [b"open 1\n", b"held\n"]
        disown(path)
        with pytest.raises(StoreInUse) as caught:
            SqliteJournal(path)
        assert caught.value.pid == child.pid
    finally:
        end(child)


def test_a_store_of_before_gets_an_identity_and_what_was_begun_of_that_is_finished(tmp_path: Path) -> None:
    path = filled(tmp_path / "app.db")
    ids = [Path(f"{path}-{folder}", "store-id") for folder in ("snapshots", "log")]
    for one in ids:
        one.unlink()
    with closing(sqlite3.connect(path, isolation_level=None)) as db:
        db.execute("DELETE FROM notes WHERE name = ?", (NOTE,))
    for step in range(2):
        assert reopened(path).snapshot == LARGE
        first, second = (one.read_text() for one in ids)
        assert first == second
        if not step:  # As if its owner had been killed while it made the second one, the database saying "pending".
            ids[1].rename(f"{ids[1]}.tmp")
            with closing(sqlite3.connect(path, isolation_level=None)) as db:
                value, crc = db.execute("SELECT value, crc FROM notes WHERE name = ?", (NOTE,)).fetchone()
                pending = b"~" + value[1:]
                assert crc == crc_of(NOTE, value)
                db.execute("UPDATE notes SET value = ?, crc = ?", (pending, crc_of(NOTE, pending)))
    ids[1].unlink()
    assert reopened(path).snapshot == LARGE  # The folder is empty: it can be nobody else's.


def test_what_a_damaged_file_holds_is_shown_as_text_in_one_line(tmp_path: Path) -> None:
    path = filled(tmp_path / "app.db")
    Path(f"{path}-snapshots", "store-id").write_bytes(b"holdfast-store \x1b[2J\n\rall is well")
    with pytest.raises(ForeignStore) as caught:
        SqliteJournal(path)
    assert str(caught.value).isprintable()
    assert r"\x1b[2J\n" in str(caught.value)


def test_a_maker_that_was_killed_leaves_nothing_in_the_way(tmp_path: Path) -> None:
    path = tmp_path / "app.db"
    filled(path)
    os.link(path, f"{path}-snapshots/new-1-1")
    assert reopened(path).snapshot == LARGE
    assert [one.name for one in made(f"{path}-snapshots")] == ["1-1.snapshot"]


def test_opening_and_erasing_remove_only_what_the_store_has_made(tmp_path: Path) -> None:
    path = filled(tmp_path / "app.db")
    with closing(SqliteJournal(path)) as journal:
        journal.keep_blocks(A, 1, [(0, memoryview(b"y" * 4096))], False)
    (packs,) = (one for one in Path(f"{path}-packs").iterdir() if one.is_dir())
    foreign = [
        Path(folder, name)
        for folder in (f"{path}-snapshots", f"{path}-log", packs)
        for name in ("precious", "precious.txt", "1.log", "note.pack", "1-1.snapshot.old")
    ]
    for one in foreign:
        one.write_text("mine")
    before = os.stat(foreign[0])
    victim = tmp_path / "victim"
    victim.write_text("precious")
    Path(f"{path}-snapshots", "7-7.snapshot").symlink_to(victim)
    with closing(SqliteJournal(path)) as journal:
        journal.erase(A)
    assert [one.read_text() for one in foreign] == ["mine"] * len(foreign)
    assert os.stat(foreign[0]).st_ino == before.st_ino
    assert victim.read_text() == "precious"


def test_a_log_that_is_a_link_is_neither_sealed_nor_read(tmp_path: Path) -> None:
    path = killed(tmp_path / "app.db")
    victim = tmp_path / "victim"
    victim.write_bytes(b"precious" * 10)
    Path(f"{path}-log", "9-9.log").symlink_to(victim)
    with pytest.raises(StoreFailed):
        SqliteJournal(path)
    assert victim.read_bytes() == b"precious" * 10


async def ask_for_ever(doer: hf.ActorRef[Doer]) -> None:
    """The store looks now and then, not at each write."""
    while True:
        await doer.ask(Note("more"), timeout=300.0)


def remove_all(path: Path) -> None:
    for one in path.parent.glob("app.db*"):
        remove(one)


def move(path: Path) -> None:
    path.rename(path.with_name("moved.db"))


def empty(path: Path) -> None:
    path.unlink()
    path.touch()


DELETE: dict[str, Callable[[Path], None]] = {
    "the database": lambda path: path.unlink(),
    "a file of the log": lambda path: made(f"{path}-log")[0].unlink(),
    "the log": lambda path: shutil.rmtree(f"{path}-log"),
    "the snapshots": lambda path: shutil.rmtree(f"{path}-snapshots"),
    "its write-ahead log": lambda path: Path(f"{path}-wal").unlink(),
    "all": remove_all,
    "moved": move,
    "replaced": empty,
}


@pytest.mark.parametrize("what", DELETE)
async def test_a_store_that_goes_while_it_is_open_acknowledges_nothing_more(tmp_path: Path, what: str) -> None:
    path = tmp_path / "app.db"
    async with hf.ActorSystem("app", store=f"sqlite:{path}", log=False) as system:
        events = system.events()
        doer = await system.start(hf.child("doer", hf.start(Doer), recovery=hf.hybrid(interval=1000.0)))
        await doer.ask(Note("one"))
        DELETE[what](path)
        with pytest.raises(StoreFailed, match="while the store was open"):
            await ask_for_ever(doer)
        with pytest.raises(StoreFailed):
            await doer.send(Note("more"))
        assert [event for event in events.take() if isinstance(event, hf.events.JournalStopped)]
    # It was told while the system ran: that is all.


async def test_a_store_that_goes_unnoticed_is_told_of_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(open_store, "LOOK_SECONDS", 3600.0)  # Nobody looks while it runs.
    path = tmp_path / "app.db"
    told: list[hf.events.Event] = []
    async with contextlib.AsyncExitStack() as stack:
        system = await stack.enter_async_context(hf.ActorSystem("app", store=f"sqlite:{path}", log=False))
        system._node.events.add_sink(told.append)
        doer = await system.start(hf.child("doer", hf.start(Doer), recovery=hf.hybrid(interval=1000.0)))
        await doer.ask(Note("one"))
        remove_all(path)
        with pytest.raises(StoreFailed, match="deleted or moved while the store was open"):
            await stack.aclose()
    assert [event for event in told if isinstance(event, hf.events.JournalStopped)]


async def test_a_backup_of_all_parts_is_the_same_store(tmp_path: Path) -> None:
    for folder in ("first", "second"):
        store = f"sqlite:{tmp_path / folder / 'app.db'}"
        (tmp_path / "first").mkdir(exist_ok=True)
        async with hf.ActorSystem("app", store=store, log=False) as system:
            doer = await system.start(hf.child("doer", hf.start(Doer), recovery=hf.hybrid(interval=1000.0)))
            await doer.ask(Note(folder))
            assert await doer.ask(Seen()) == ["first", "second"][: 1 + (folder == "second")]
        if folder == "first":
            shutil.copytree(tmp_path / "first", tmp_path / "second")


def test_two_that_make_a_store_at_once_make_one(tmp_path: Path) -> None:
    imports = "import sys; from holdfast.checkpoint.sqlite import SqliteJournal"
    script = f"{imports}; sys.stdin.read(1); SqliteJournal(sys.argv[1])"
    command = [sys.executable, "-c", script, str(tmp_path / "app.db")]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    makers = [subprocess.Popen(command, env=env, stdin=subprocess.PIPE, stderr=subprocess.PIPE) for _ in range(3)]
    errors = [maker.communicate(b"x")[1].decode() for maker in makers]
    assert all(not error or "StoreInUse" in error for error in errors), errors
    assert any(not error for error in errors)
    SqliteJournal(tmp_path / "app.db").close()


def test_a_link_to_the_database_is_not_followed_away_from_its_parts(tmp_path: Path) -> None:
    path = killed(made_in(tmp_path / "a"))
    path.rename(path.with_name("elsewhere"))
    path.symlink_to("elsewhere")
    before = content(path.parent)
    with pytest.raises(ForeignStore, match=r"app\.db-log of a store lie beside it"):
        SqliteJournal(path)
    assert content(path.parent) == before
    path.unlink()
    path.with_name("elsewhere").rename(path)
    assert numbers(reopened(path))


def test_a_wal_that_was_away_is_put_back_and_nothing_is_lost(tmp_path: Path) -> None:
    path = killed(made_in(tmp_path / "a"))
    copy = shutil.copytree(path.parent, tmp_path / "b")
    Path(f"{path}-wal").rename(tmp_path / "wal")
    with pytest.raises(DamagedStore, match="were acknowledged"):
        SqliteJournal(path)
    (tmp_path / "wal").rename(f"{path}-wal")
    assert numbers(reopened(path)) == numbers(reopened(copy / "app.db"))


def test_a_folder_that_takes_no_store_is_told_with_what_to_do() -> None:
    """Nobody may make files there, whoever they are."""
    with pytest.raises(StoreFailed, match=r"have its folder there, .* writable to this user, and start again"):
        SqliteJournal("/proc/app.db")
