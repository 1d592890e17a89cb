"""`dynamic(journal=True)`: its children come back with it (DESIGN 5), whatever ended it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.actors.persistence import child_key
from tests.checkpoint.players import Doer, Note, Seen, until
from tests.checkpoint.strikes import event
from tests.checkpoint.trees import running
from tests.control.players import Account, Total

pytestmark = pytest.mark.usefixtures("warm_programs")


class Pupil(hf.Actor):
    """Has a name, and learns words."""

    def __init__(self, name: str = "nobody", town: str = "nowhere") -> None:
        self.words = [f"{name} of {town}"]

    @hf.on(Note)
    def note(self, message: Note) -> int:
        self.words.append(message.text)
        return len(self.words)

    @hf.on(Seen, readonly=True)
    def read(self, message: Seen) -> list[str]:
        return self.words


class Shy(hf.Actor):
    """Does not start while there is such a file."""

    def __init__(self, path: str, how: str) -> None:
        if Path(path).exists():
            raise hf.Ignore if how == "ignore" else OSError("not now")

    @hf.on(Seen, readonly=True)
    def read(self, message: Seen) -> list[str]:
        return ["here"]


@hf.renamed(f"{__name__}:Pupil")
class Student(hf.Actor):
    """The next release of a pupil: its words are numbered."""

    schema_version = 2

    def __init__(self, name: str = "nobody", town: str = "nowhere") -> None:
        self.numbered = {0: f"{name} of {town}"}

    @classmethod
    def migrate(cls, state: dict[str, Any], from_version: int) -> dict[str, Any]:
        assert from_version == 1
        return {"numbered": dict(enumerate(state["words"]))}

    @hf.on(Note)
    def note(self, message: Note) -> int:
        self.numbered[len(self.numbered)] = message.text
        return len(self.numbered)

    @hf.on(Seen, readonly=True)
    def read(self, message: Seen) -> list[str]:
        return list(self.numbered.values())


PUPIL = hf.child(None, hf.start(Pupil), recovery=hf.hybrid())


def school(template: hf.ChildSpec | None = None, **options: Any) -> hf.ChildSpec:
    flags: dict[str, Any] = {"intensity": 5, **options}
    return hf.dynamic("school", template=template, journal=True, **flags)


@pytest.fixture(params=["memory", "sqlite"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> str | None:
    return None if request.param == "memory" else f"sqlite:{tmp_path / 'app.db'}"


@pytest.fixture(params=["task", "process"])
def isolation(request: pytest.FixtureRequest) -> Any:
    """Where the dynamic supervisor lives, with its children."""
    return request.param


async def restarted(system: hf.ActorSystem) -> None:
    with system.events() as stream:
        system.ref("/app/school", hf.Supervisor).kill()
        async for one in stream:
            if isinstance(one, hf.events.ChildRestarted):
                break
    await until(lambda: "/app/school" in system.tree() and up(system))


def up(system: hf.ActorSystem) -> bool:
    cell = system.ref("/app/school", hf.Supervisor)._cell
    return cell.host.is_up(cell)


async def ids(system: hf.ActorSystem) -> list[str]:
    there = await system.ref("/app/school", hf.Supervisor).ask(hf.WhichChildren(), timeout=20.0)
    return [one.id for one in there if one.state == "running"]


async def words(system: hf.ActorSystem, name: str) -> list[str]:
    await until(lambda: f"/app/school/{name}" in system.tree())
    return await system.ref(f"/app/school/{name}", hf.Actor).ask(Seen(), timeout=20.0)


async def test_children_come_back_in_order_with_their_arguments_and_what_they_have_learnt(
    store: str | None, isolation: Any
) -> None:
    async with running(store) as system:
        top = await system.start(school(PUPIL, isolation=isolation))
        bob = await top.ask(hf.StartChild(args=("Bob",), kwargs={"town": "Rome"}))
        await top.ask(hf.StartChild(args=("Ann",), id="ann"))
        await bob.ask(Note("salve"))
        await restarted(system)
        name = bob.path.rpartition("/")[2]
        assert await ids(system) == [name, "ann"]
        assert await words(system, name) == ["Bob of Rome", "salve"]
        assert await words(system, "ann") == ["Ann of nowhere"]


async def test_without_a_journal_it_starts_empty(isolation: Any) -> None:
    async with running(None) as system:
        top = await system.start(hf.dynamic("school", template=PUPIL, isolation=isolation, intensity=5))
        await top.ask(hf.StartChild(args=("Bob",)))
        await restarted(system)
        assert await ids(system) == []


async def test_they_come_back_when_the_same_tree_is_started_from_the_same_store(tmp_path: Path, isolation: Any) -> None:
    store = f"sqlite:{tmp_path / 'app.db'}"
    async with running(store) as system:
        top = await system.start(school(isolation=isolation))
        await top.ask(hf.StartChild(hf.child("doer", hf.start(Doer), recovery=hf.hybrid())))
        bob = await top.ask(hf.StartChild(hf.start(Pupil, "Bob")))
        await system.ref("/app/school/doer", Doer).ask(Note("kept"))
    async with running(store) as system:
        await system.start(school(isolation=isolation))
        name = bob.path.rpartition("/")[2]
        assert await ids(system) == ["doer", name]
        assert await words(system, "doer") == ["kept"]
        assert await words(system, name) == ["Bob of nowhere"]


async def test_who_has_ended_for_good_does_not_come_back(store: str | None, isolation: Any) -> None:
    async with running(store) as system:
        top = await system.start(school(PUPIL, isolation=isolation))
        for name in ("ann", "bob", "cleo"):
            await top.ask(hf.StartChild(args=(name,), id=name))
        await top.ask(hf.TerminateChild("ann"))
        await system.stop(system.ref("/app/school/bob", Pupil))
        await restarted(system)
        assert await ids(system) == ["cleo"]


async def test_who_has_ended_is_restored_by_its_name_if_it_was_given_one(store: str | None, isolation: Any) -> None:
    async with running(store) as system:
        top = await system.start(school(PUPIL, isolation=isolation))
        bob = await top.ask(hf.StartChild(args=("Bob",), id="bob"))
        await bob.ask(Note("secret"))
        await top.ask(hf.TerminateChild("bob"))
        await restarted(system)
        again = await top.ask(hf.StartChild(args=("Bob",), id="bob"))
        assert await again.ask(Seen()) == ["Bob of nowhere", "secret"]
        await top.ask(hf.TerminateChild("bob"))
        anew = await top.ask(hf.StartChild(args=("Bob",), id="bob", fresh=True))
        assert await anew.ask(Seen()) == ["Bob of nowhere"]


@pytest.mark.parametrize("template", [PUPIL, None])
async def test_nothing_stays_of_one_with_a_made_up_id_that_has_ended_for_good(
    store: str | None, isolation: Any, template: hf.ChildSpec | None
) -> None:
    async with running(store) as system:
        top = await system.start(school(template, isolation=isolation))
        how = [hf.StartChild(PUPIL if template is None else None, args=()) for _ in range(3)]
        one, two, three = [await top.ask(start) for start in how]
        for pupil in (one, two, three):
            await pupil.ask(Note("secret"))
        await restarted(system)
        assert await two.ask(Seen()) == ["nobody of nowhere", "secret"]
        await top.ask(hf.TerminateChild(one.path.rpartition("/")[2]))
        await system.stop(three)
        await until(lambda: system._homes.known("/app/school") == [two.path])
        await restarted(system)
        assert [f"/app/school/{name}" for name in await ids(system)] == [two.path]
        new = await top.ask(how[0])
        assert await new.ask(Seen()) == ["nobody of nowhere"], "it is nobody else"


async def test_what_was_recorded_of_one_that_has_ended_can_be_erased(store: str | None, isolation: Any) -> None:
    async with running(store) as system:
        top = await system.start(school(PUPIL, isolation=isolation))
        bob = await top.ask(hf.StartChild(args=("Bob",), id="bob"))
        await bob.ask(Note("secret"))
        with pytest.raises(hf.errors.NotSupported):
            await top.ask(hf.DeleteChild("bob"))
        await top.ask(hf.TerminateChild("bob"))
        with pytest.raises(hf.errors.NoSuchChild):
            await top.ask(hf.DeleteChild("bob", erase=False))
        await top.ask(hf.DeleteChild("bob"))
        with pytest.raises(hf.errors.NoSuchChild):
            await top.ask(hf.DeleteChild("bob"))
        await restarted(system)
        again = await top.ask(hf.StartChild(args=("Bob",), id="bob"))
        assert await again.ask(Seen()) == ["Bob of nowhere"]


async def test_what_the_store_refuses_to_forget_is_an_error_and_can_be_forgotten_later(
    store: str | None, isolation: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(address: str) -> None:
        raise hf.HoldfastError("the disk is gone")

    async with running(store) as system:
        top = await system.start(school(PUPIL, isolation=isolation))
        bob = await top.ask(hf.StartChild(args=("Bob",), id="bob"))
        made_up = await top.ask(hf.StartChild(args=("Ann",)))
        for pupil in (bob, made_up):
            await pupil.ask(Note("secret"))
        await top.ask(hf.TerminateChild("bob"))
        with monkeypatch.context() as broken, system.events() as events:
            broken.setattr(system._homes.journal, "erase", refuse)
            with pytest.raises(hf.HoldfastError, match="the disk is gone"):
                await top.ask(hf.DeleteChild("bob"))
            with pytest.raises(hf.HoldfastError, match="the disk is gone"):
                await top.ask(hf.StartChild(args=("Bob",), id="bob", fresh=True))
            await top.ask(hf.TerminateChild(made_up.path.rpartition("/")[2]))  # It is over, whatever the store says.
            refused: hf.events.StoreRefused = await event(events, hf.events.StoreRefused)
        assert (refused.address, refused.reason) == (made_up.path, "the disk is gone")
        assert set(system._homes.known("/app/school")) == {bob.path, made_up.path}
        await top.ask(hf.DeleteChild("bob"))
        await restarted(system)
        await until(lambda: not system._homes.known("/app/school"))


async def test_a_start_that_fails_or_is_refused_leaves_nothing_in_the_journal(
    store: str | None, isolation: Any, tmp_path: Path
) -> None:
    blocked = tmp_path / "blocked"
    blocked.touch()
    async with running(store) as system:
        top = await system.start(school(isolation=isolation, max_children=1))
        with pytest.raises(hf.StartFailed):
            await top.ask(hf.StartChild(hf.child("bad", hf.start(Shy, str(blocked), "fail"))))
        assert await top.ask(hf.StartChild(hf.child("shy", hf.start(Shy, str(blocked), "ignore")))) is None
        await top.ask(hf.StartChild(hf.child("good", hf.start(Pupil, "Ann"))))
        with pytest.raises(hf.errors.MaxChildren):
            await top.ask(hf.StartChild(hf.child("more", hf.start(Pupil, "Bob"))))
        blocked.unlink()
        await restarted(system)
        assert await ids(system) == ["good"]
        assert list(system._node.ports.keeper.notes("child ")) == ["child /app/school/good"]


async def test_one_that_fails_to_come_back_is_tried_again_and_does_not_keep_the_others_away(
    store: str | None, tmp_path: Path
) -> None:
    blocked = tmp_path / "blocked"
    async with running(store) as system:
        backoff = hf.Backoff(initial=0.05, maximum=0.05)
        top = await system.start(school(intensity=1000))
        await top.ask(hf.StartChild(hf.child("bad", hf.start(Shy, str(blocked), "fail"), backoff=backoff)))
        await top.ask(hf.StartChild(hf.child("good", hf.start(Pupil, "Ann"))))
        blocked.touch()
        await restarted(system)
        assert await ids(system) == ["good"]
        blocked.unlink()
        assert await words(system, "bad") == ["here"]


async def test_what_cannot_be_kept_is_refused_and_not_started(store: str | None) -> None:
    class Local(hf.Actor): ...

    async with running(store) as system:
        top = await system.start(school())
        with pytest.raises(hf.SpecError, match="defined in a function"):
            await top.ask(hf.StartChild(hf.start(Local)))
        with pytest.raises(hf.HoldfastError, match="cannot be"):
            await top.ask(hf.StartChild(hf.start(Pupil, "x", object())))  # type: ignore[arg-type]
        assert await ids(system) == []


async def test_a_fresh_or_deleted_supervisor_has_no_children(store: str | None, isolation: Any) -> None:
    async with running(store) as system:
        root = system.ref("/app", hf.Supervisor)
        top = await system.start(school(PUPIL, isolation=isolation))
        bob = await top.ask(hf.StartChild(args=("Bob",), id="bob"))
        await bob.ask(Note("gone"))
        await root.ask(hf.TerminateChild("school"), timeout=20.0)
        await root.ask(hf.RestartChild("school"), timeout=20.0)
        assert await words(system, "bob") == ["Bob of nowhere", "gone"]
        await root.ask(hf.TerminateChild("school"), timeout=20.0)
        await root.ask(hf.RestartChild("school", fresh=True), timeout=20.0)
        assert await ids(system) == []
        bob = await system.ref("/app/school", hf.Supervisor).ask(hf.StartChild(args=("Bob",), id="bob"))
        assert await bob.ask(Seen()) == ["Bob of nowhere"]


@pytest.mark.parametrize("journal", [1, "yes", None])
def test_journal_is_yes_or_no(journal: Any) -> None:
    with pytest.raises(hf.SpecError, match="journal must be True or False"):
        hf.dynamic("x", journal=journal)


@pytest.mark.parametrize("place", ["task", "process"])
def test_who_waits_at_a_made_up_id_when_the_root_dies_is_told_by_the_next(tmp_path: Path, place: str) -> None:
    """Without a journal nobody comes back there: the ask of a recorded turn fails, the rest are dead letters."""
    script = Path(__file__).with_name("made_up_player.py")
    paths = os.pathsep.join(filter(None, (str(Path(hf.__file__).parents[1]), os.environ.get("PYTHONPATH"))))
    for life, code in (("first", -9), ("second", 0)):
        command = [sys.executable, str(script), str(tmp_path / "app.db"), life, place]
        environment = {**os.environ, "PYTHONPATH": paths}
        ended = subprocess.run(command, capture_output=True, text=True, timeout=60, env=environment)
        assert ended.returncode == code, ended.stderr
    outcome, dead, still_recorded = json.loads(ended.stdout)
    assert outcome == "ActorStopped"
    assert dead == ["Hold", "Ping"]
    assert not still_recorded


async def test_a_child_comes_back_where_it_lives_now_and_as_what_it_is(store: str | None) -> None:
    async with hf.ActorSystem("app", store=store, log=False) as system:
        supervisor = await system.start(school())
        ann = await supervisor.ask(hf.StartChild(hf.child("ann", hf.start(Pupil))))
        await system.set_isolation(ann, "process")
        await system.ref("/app", hf.Supervisor).ask(hf.RestartChild("school", running=True))
        assert system.pid_of(system.ref("/app/school/ann", Pupil)) != os.getpid()


@pytest.mark.parametrize("of", ["template", "spec"])
async def test_code_that_was_replaced_comes_back_with_the_supervisor(
    store: str | None, isolation: Any, of: str
) -> None:
    """Its state is that of the new class by then: the old one could not take it, and would be rolled back."""
    async with running(store) as system:
        above = await system.start(school(PUPIL if of == "template" else None, isolation=isolation))
        first = (
            hf.StartChild(args=("ann",), id="ann")
            if of == "template"
            else hf.StartChild(hf.child("ann", hf.start(Pupil, "ann"), recovery=hf.hybrid()))
        )
        ann = await above.ask(first)
        await ann.ask(Note("one"))
        async with system.transaction() as change:
            change.replace_code(ann, Student)
        assert await ann.ask(Note("two")) == 3
        for _ in range(2):
            with system.events() as events:
                await restarted(system)
                assert await ann.ask(Seen(), timeout=20.0) == ["ann of nowhere", "one", "two"]
                assert not [
                    one for one in events.take() if isinstance(one, (hf.events.RolledBack, hf.events.RecoveryFailed))
                ]
        if of == "template":  # Others begin as the template says.
            ben = await above.ask(hf.StartChild(args=("ben",), id="ben"))
            assert await ben.ask(Seen()) == ["ben of nowhere"]
        if isolation == "task":  # Where it lives is noted with its class.
            await system.set_isolation(ann, "process")
            await restarted(system)
            assert await ann.ask(Note("three"), timeout=20.0) == 4
            assert system.pid_of(ann) != os.getpid()


STORED = (
    b"\x01\x01\x00\x00\x00\x00\x00\x00\x01\xd2\x96\xc7\x00%\xd94holdfast.actors.process.wire.start_codec:_PackedData"
    b"\xa6fields\xde\x00\x15\xa2id\xa3one\xa5start\x98\xc7\x00%\xd90holdfast.actors.process.wire.start_codec:_Packed\xa4args"
    b"\x92\xc7\x00\x01\x03\xa4kind\xbdtests.control.players:Account\xa6kwargs\x80\xa7restart\xa9permanent\xa8shutdown"
    b"\xcb@\x14\x00\x00\x00\x00\x00\x00\xa9isolation\xa4task\xa8recovery\xc0\xa7mailbox\xc0\xa7backoff\xc0\xa6limits\xc0"
    b"\xa8bindings\x80\xadis_supervisor\xc2\xabsignificant\xc2\xa5rules\x91\xc7\x00\x01\xa9mechanism\xc0\xaacomes_back"
    b"\xc3\xa7made_up\xc2\xadstart_timeout\xcb@N\x00\x00\x00\x00\x00\x00\xa9autostart\xc3\xa4late\x91\xc7\x00\x03"
    b"\xa8register\xa4bank\xa5scope\xa5fleet\xa4kind\xd9#holdfast.supervision.spec:ChildSpec"
)
"""The spec of a child with a name as it was once stored: a text, and beside it who finds the child by that."""


@pytest.mark.parametrize(
    ("stored", "scope"),
    [(STORED, "fleet"), (STORED.replace(b"\xa5fleet", b"\xa6system").replace(b"\x01\xd2", b"\x01\xd3"), "system")],
    ids=["fleet", "system"],
)
@pytest.mark.parametrize("isolation", ["task", "process"])
async def test_a_name_that_an_earlier_version_has_stored_is_given_again(
    tmp_path: Path, isolation: Any, stored: bytes, scope: str
) -> None:
    store = f"sqlite:{tmp_path / 'names.db'}"
    async with hf.ActorSystem("app", log=False, store=store) as system:
        system._node.ports.keeper.note(child_key("/app/books", "one"), stored)
    for _ in range(2):
        async with hf.ActorSystem("app", log=False, store=store) as system:
            books = await system.start(hf.dynamic("books", journal=True, isolation=isolation))
            assert system.whereis("bank").path == "/app/books/one"
            assert system.whereis("bank")._cell.extra().belongings.names == {"bank": scope}
            assert await system.whereis("bank").ask(Total(), 20) == 3
            two = hf.child("two", hf.start(Account), register="till", scope=scope)  # type: ignore[arg-type]
            if "/app/books/two" not in system.tree():
                await books.ask(hf.StartChild(two), 20)
            assert system.whereis("till")._cell.extra().belongings.names == {"till": scope}
