"""What was recorded is forgotten by address: for every kind of child, in steps, and by whoever may be next."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import holdfast
import holdfast as hf
from holdfast.checkpoint.sqlite import SqliteJournal
from holdfast.errors import ControlFailed
from holdfast.supervision import EndedChildren
from tests.checkpoint.players import Do, Doer, until
from tests.erasing.tenants import ACME, OTHER, Doc, Get, Parse, Place, Put, fill, nothing, read, tenant, tenants

pytestmark = pytest.mark.usefixtures("warm_programs")

SCRIPT = Path(__file__).with_name("tenants.py")
PATHS = os.pathsep.join(
    filter(None, (str(Path(holdfast.__file__).parents[1]), str(SCRIPT.parents[2]), os.environ.get("PYTHONPATH")))
)
STORES = pytest.mark.parametrize("with_store", [True, False], ids=["sqlite", "memory"])
PLACES = pytest.mark.parametrize("place", ["task", "process"])


def store_in(folder: Path) -> str:
    return f"sqlite:{folder / 'app.db'}"


def opened(folder: Path, *, with_store: bool = True) -> hf.ActorSystem:
    return hf.ActorSystem("app", store=store_in(folder) if with_store else None, log=False, intensity=100)


def found(folder: Path, *words: str) -> dict[str, int]:
    """How often these words are in the files of a folder, and in their names."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {word: sum(path.read_bytes().count(word.encode()) + (word in str(path)) for path in files) for word in words}


def command(*words: str) -> subprocess.CompletedProcess[str]:
    program = [sys.executable, "-m", "holdfast.console.cli", "store", *words]
    return subprocess.run(program, capture_output=True, text=True, timeout=60, check=False)


@STORES
@PLACES
async def test_a_tenant_below_a_dynamic_supervisor_is_deleted(tmp_path: Path, with_store: bool, place: Place) -> None:
    async with opened(tmp_path, with_store=with_store) as system:
        top = await tenants(system, tenant("acme", place), tenant("other", place))
        await fill(system, ACME, 3)
        await fill(system, OTHER, 1)
        await top.ask(hf.TerminateChild("acme"), 20.0)
        assert [one.is_recorded for one in await top.ask(EndedChildren())] == [True]
        await top.ask(hf.DeleteChild("acme"), 20.0)
        counted = await system.erase(ACME, dry_run=True)
        assert (counted.addresses, counted.children) == (0, 0)
        with pytest.raises(hf.Refusal):
            await top.ask(hf.DeleteChild("acme"))
        await top.ask(hf.StartChild(tenant("acme", place)), 20.0)
        assert await read(system, ACME) == [[]]
        assert await read(system, OTHER) == [["words"], ["words"]]


@PLACES
async def test_a_tenant_below_a_static_supervisor_in_any_place_is_said_to_be_recorded(place: Place) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        top = await system.start(hf.supervisor("tenants", isolation=place))
        await top.ask(hf.StartChild(tenant("acme")), 20.0)
        await fill(system, ACME, 1)
        await top.ask(hf.TerminateChild("acme"), 20.0)
        assert [one.is_recorded for one in await top.ask(EndedChildren())] == [True]


@STORES
async def test_others_get_their_turns_while_much_is_erased(tmp_path: Path, with_store: bool) -> None:
    async with opened(tmp_path, with_store=with_store) as system:
        top = await tenants(system, tenant("acme"), tenant("other"))
        await fill(system, ACME, 150)
        await fill(system, OTHER, 0)
        await top.ask(hf.TerminateChild("acme"), 20.0)
        deleted = asyncio.ensure_future(top.ask(hf.DeleteChild("acme"), 60.0))
        answers = 0
        while not deleted.done():
            await system.ref(f"{OTHER}/profile", Doc).ask(Get())
            assert [one.id for one in await top.ask(hf.WhichChildren())] == ["other"]
            answers += 1
        await deleted
        assert answers >= 10
        assert (await system.erase(ACME, dry_run=True)).addresses == 0


async def test_who_is_started_where_is_being_erased_waits_and_begins_afresh(tmp_path: Path) -> None:
    async with opened(tmp_path) as system:
        top = await tenants(system, tenant("acme"))
        await fill(system, ACME, 60)
        await top.ask(hf.TerminateChild("acme"), 20.0)
        asyncio.ensure_future(top.ask(hf.DeleteChild("acme"), 0.001)).add_done_callback(lambda done: done.exception())
        erased = asyncio.ensure_future(system.erase(ACME))
        await asyncio.sleep(0)
        again = asyncio.ensure_future(top.ask(hf.StartChild(tenant("acme")), 30.0))
        await again
        assert erased.done(), "the start has waited for it"
        assert (await erased).events > 0
        await fill(system, ACME, 1, "new")
    async with opened(tmp_path) as system:
        await tenants(system, tenant("acme"))
        assert await read(system, ACME) == [["new"], ["new"]]


async def test_what_the_store_has_refused_is_erased_before_anybody_begins_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(address: str) -> None:
        raise hf.HoldfastError("the disk is gone")

    async with opened(tmp_path) as system:
        top = await tenants(system, tenant("acme"))
        await fill(system, ACME, 20)
        await top.ask(hf.TerminateChild("acme"), 20.0)
        with monkeypatch.context() as broken:
            broken.setattr(system._homes.journal, "erase", refuse)
            with pytest.raises(hf.HoldfastError, match="the disk is gone"):
                await system.erase(ACME)
            with pytest.raises(hf.StartFailed, match="is not erased: the disk is gone"):
                await top.ask(hf.StartChild(tenant("acme")), 20.0)
        await top.ask(hf.StartChild(tenant("acme")), 20.0)
        await fill(system, ACME, 1, "new")
    async with opened(tmp_path) as system:
        await tenants(system, tenant("acme"))
        assert await read(system, ACME) == [["new"], ["new"]], "the next program erases nothing that came later"


async def test_who_was_not_started_in_this_program_is_erased(tmp_path: Path) -> None:
    async with opened(tmp_path) as system:
        await tenants(system, tenant("acme"), tenant("other"))
        await fill(system, ACME, 2)
        await fill(system, OTHER, 2)
    async with opened(tmp_path) as system:
        counted = await system.erase(ACME, dry_run=True)
        erased = await system.erase(ACME)
        assert (erased.addresses, erased.children) == (3, 2)
        assert erased == counted
        assert await system.erase(ACME) == nothing(ACME)
        await tenants(system, tenant("acme"), tenant("other"))
        assert await read(system, ACME) == [[]]
        assert len(await read(system, OTHER)) == 3


@PLACES
async def test_who_lives_or_comes_back_is_not_erased(place: Place) -> None:
    async with hf.ActorSystem("app", log=False) as system:
        top = await tenants(system, tenant("acme", place))
        await fill(system, ACME, 1)
        for path in (ACME, f"{ACME}/profile", f"{ACME}/docs/d0", "/app/tenants"):
            with pytest.raises(ControlFailed, match="stop it first"):
                await system.erase(path)
        with pytest.raises(hf.SpecError, match="is no supervisor"):
            await system.erase(f"{ACME}/profile/below")
        for wrong in ("/app", "/other/a", "tenants", "/app/tenants/"):
            with pytest.raises(hf.SpecError):
                await system.erase(wrong)
        assert await read(system, ACME) == [["words"], ["words"]]
        await system.ref(f"{ACME}/docs").ask(hf.TerminateChild("d0"), 20.0)
        assert (await system.erase(f"{ACME}/docs/d0")).addresses == 1
        await system.ref(f"{ACME}/docs").ask(hf.StartChild(id="d0"), 20.0)
        assert await read(system, ACME) == [["words"], []]
        await top.ask(hf.TerminateChild("acme"), 20.0)


async def test_who_waits_to_be_restarted_is_not_erased() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        spec = hf.child("doc", hf.start(Doc), recovery=hf.hybrid(), backoff=hf.Backoff(30.0, 60.0))
        top = await system.start(hf.supervisor("top", children=[spec], intensity=100))
        doc = system.ref("/app/top/doc", Doc)
        await doc.ask(Put("words"))
        doc.tell(Parse("x"))
        while (await top.ask(hf.WhichChildren()))[0].state != "restarting":
            doc.tell(Parse("x"))
            await asyncio.sleep(0.001)
        with pytest.raises(ControlFailed, match="stop it first"):
            await system.erase(doc)


async def test_a_stopped_child_of_a_static_supervisor_begins_afresh() -> None:
    async with hf.ActorSystem("app", log=False) as system:
        spec = hf.child("doc", hf.start(Doc), recovery=hf.hybrid())
        top = await system.start(hf.supervisor("top", children=[spec]))
        doc = system.ref("/app/top/doc", Doc)
        await doc.ask(Put("words"))
        await top.ask(hf.TerminateChild("doc"))
        assert (await system.erase("/app/top/doc")).addresses == 1
        await top.ask(hf.RestartChild("doc"))
        assert await system.ref("/app/top/doc", Doc).ask(Get()) == []


async def test_who_has_moved_away_keeps_what_was_recorded(tmp_path: Path) -> None:
    spec = hf.child("doc", hf.start(Doc), recovery=hf.hybrid())
    async with opened(tmp_path) as system:
        first = await system.start(hf.supervisor("first", children=[spec]))
        second = await system.start(hf.supervisor("second"))
        await system.ref("/app/first/doc", Doc).ask(Put("words"))
        async with system.transaction() as change:
            change.move("/app/first/doc", second)
        with pytest.raises(ControlFailed, match="was moved to /app/second/doc"):
            await system.erase("/app/first/doc")
        await first.ask(hf.StartChild(spec, fresh=True))
        assert await system.ref("/app/first/doc", Doc).ask(Get()) == []
        assert await system.ref("/app/second/doc", Doc).ask(Get()) == ["words"]
        assert system._homes.journal.load("/app/second/doc").entries, "the store has them, too"
        await first.ask(hf.TerminateChild("doc"))
        await system.erase("/app/first/doc")
        await second.ask(hf.TerminateChild("doc"))
        await second.ask(hf.RestartChild("doc"))
        assert await system.ref("/app/second/doc", Doc).ask(Get()) == ["words"]


async def test_a_protected_actor_is_erased_with_its_replicas_and_the_note_of_its_mechanism(tmp_path: Path) -> None:
    async with opened(tmp_path) as system:
        spec = hf.child("doc", hf.start(Doc), recovery=hf.hybrid())
        top = await system.start(hf.supervisor("top", children=[spec]))
        async with system.transaction() as change:
            change.protect("/app/top/doc", hf.ftm.PBR())
        doc = system.ref("/app/top/doc", Doc)
        await doc.ask(Put("SECRET"), 20.0)
        with pytest.raises((hf.SpecError, ControlFailed)):
            await system.erase("/app/top/doc/ftm")
        await top.ask(hf.TerminateChild("doc"), 20.0)
        erased = await system.erase("/app/top/doc")
        assert erased.addresses >= 1
        assert erased.others == 1
    await asyncio.to_thread(command, "compact", str(tmp_path / "app.db"))
    assert found(tmp_path, "SECRET", "/app/top/doc") == {"SECRET": 0, "/app/top/doc": 0}


@pytest.mark.parametrize("key", [None, b"k" * 32], ids=["plain", "encrypted"])
async def test_nothing_is_left_in_any_file(tmp_path: Path, key: bytes | None) -> None:
    secrets = ("SECRET-STATE", "PASSPORT-4711", "acme")
    folder, copy = tmp_path / "live", tmp_path / "copy"
    folder.mkdir()
    copy.mkdir()
    key_file = tmp_path / "key"
    key_file.write_bytes(key or b"")
    key_file.chmod(0o600)
    with_key = ("--key-file", str(key_file)) if key else ()
    async with hf.ActorSystem("app", store=store_in(folder), store_key=key, log=False, intensity=100) as system:
        top = await tenants(system, tenant("acme"), tenant("other"))
        for path, mine in ((ACME, True), (OTHER, False)):
            await fill(system, path, 3, "SECRET-STATE" if mine else "PUBLIC")
            with pytest.raises(hf.RemoteCrash):
                await system.ref(f"{path}/profile", Doc).ask(Parse("PASSPORT-4711" if mine else "PUBLIC"))
        assert (await system.ref(f"{ACME}/profile", Doc).ask(Get())) == ["SECRET-STATE"]
        await until(lambda: any(b"cannot parse PUBLIC" in one for one in system._homes.notes("history ").values()))
        await system.backup(copy / "app.db")
        await top.ask(hf.TerminateChild("acme"), 20.0)
        assert (await system.erase(ACME)).events > 0
        assert not [event for event in system.history().events if "acme" in str(event)]
        assert [event for event in system.history().events if "PUBLIC" in str(event)]
    done = await asyncio.to_thread(command, "compact", str(folder / "app.db"), *with_key)
    assert done.returncode == 0, done.stderr
    assert found(folder, *secrets) == dict.fromkeys(secrets, 0)
    words = ("erase", str(copy / "app.db"), ACME, *with_key)
    counted = await asyncio.to_thread(command, *words, "--dry-run", "--json")
    refused = await asyncio.to_thread(command, *words)
    assert (refused.returncode, "--yes" in refused.stderr) == (1, True)
    done = await asyncio.to_thread(command, *words, "--yes", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == json.loads(counted.stdout)
    assert json.loads(done.stdout)["addresses"] == 4
    assert found(copy, *secrets) == dict.fromkeys(secrets, 0)
    assert key is not None or found(copy, "PUBLIC")["PUBLIC"]
    for place in (folder, copy):
        printed = await asyncio.to_thread(command, "export", str(place / "app.db"), *with_key)
        assert [printed.stdout.count(word) for word in secrets] == [0, 0, 0]
        assert "cannot parse PUBLIC" in printed.stdout, "the history is printed in words"
        async with hf.ActorSystem("app", store=store_in(place), store_key=key, log=False) as system:
            await tenants(system, tenant("acme"), tenant("other"))
            assert await read(system, ACME) == [[]]
            assert await read(system, OTHER) == [["PUBLIC"]] * 4


async def test_what_was_put_aside_is_erased(tmp_path: Path) -> None:
    recovery = hf.hybrid(max_deliveries=1)
    spec = hf.child("doer", hf.start(Doer), isolation="process", recovery=recovery)
    async with opened(tmp_path) as system:
        top = await system.start(hf.supervisor("top", children=[spec], intensity=100))
        doer = system.ref("/app/top/doer", Doer)
        for text in ("SECRET-FIRST", "SECRET-SECOND"):
            with pytest.raises(hf.Quarantined):
                await doer.ask(Do([f"add {text}", f"die {tmp_path / 'deaths'}"]), timeout=30.0)
        system.drop(system.quarantined()[0])
        await top.ask(hf.TerminateChild("doer"), 20.0)
        assert (await system.erase(doer)).put_aside == 1
        assert system.quarantined() == []
    await asyncio.to_thread(command, "compact", str(tmp_path / "app.db"))
    assert found(tmp_path, "SECRET") == {"SECRET": 0}


async def test_group_snapshots_are_erased(tmp_path: Path) -> None:
    async with opened(tmp_path) as system:
        top = await tenants(system, tenant("acme"), tenant("other"))
        await fill(system, ACME, 1)
        await fill(system, OTHER, 1)
        await system.checkpoint_group([f"{ACME}/profile", f"{OTHER}/profile"], name="both")
        await system.checkpoint_group([f"{OTHER}/profile"], name="one")
        await top.ask(hf.TerminateChild("acme"))
        assert (await system.erase(ACME)).others == 1
        assert system.group_snapshots() == ["one"]


def test_each_address_costs_what_it_has_itself(tmp_path: Path) -> None:
    journal = SqliteJournal(tmp_path / "app.db")
    for number in range(20):
        journal.append([(f"/app/{number}", ("note", number))])
        journal.cut(f"/app/{number}", b"state", [], turn=1)
        journal.note(f"child /app/{number}", b"")
    db, said = journal._store.db, list[str]()
    db.set_trace_callback(said.append)
    journal.erase("/app/7")
    journal.note("child /app/7", None)
    db.set_trace_callback(None)
    looks = [one for one in said if one.startswith(("SELECT", "DELETE", "UPDATE"))]
    plans = {one: [row[-1] for row in db.execute(f"EXPLAIN QUERY PLAN {one}")] for one in looks}
    large = ("entries", "snapshots", "addresses", "notes")
    assert not [one for one, plan in plans.items() for step in plan if step in [f"SCAN {name}" for name in large]]
    journal.close()


async def filled(folder: Path) -> None:
    async with opened(folder) as system:
        await tenants(system, tenant("acme"), tenant("other"), tenant("third"))
        for path in (ACME, OTHER, "/app/tenants/third"):
            await fill(system, path, 2)


async def test_an_erasure_that_was_cut_off_is_finished_by_the_next_program(tmp_path: Path) -> None:
    (tmp_path / "first").mkdir()
    await filled(tmp_path / "first")
    outcomes: set[str] = set()
    for count in range(1, 100):
        folder = tmp_path / str(count)
        shutil.copytree(tmp_path / "first", folder)
        program = [sys.executable, str(SCRIPT), store_in(folder), str(count)]
        environment = {**os.environ, "PYTHONPATH": PATHS}
        done = await asyncio.to_thread(subprocess.run, program, env=environment, timeout=60, check=False)
        if (folder / "app.db.done").exists():  # What is killed now is the end of the program.
            break
        assert done.returncode == -9
        async with opened(folder) as system:
            outcomes.add(await all_or_nothing(system))
            assert len(await left(system, "/app/tenants/third")) == 3
        shutil.rmtree(folder)
    else:
        raise AssertionError("it never came to an end")
    assert count > 12
    assert outcomes == {"none", "one", "both"}, "a kill came before the first note, between the two, and later"


async def left(system: hf.ActorSystem, path: str) -> list[str]:
    return sorted(one for one in system._homes.tree_of(path))


async def all_or_nothing(system: hf.ActorSystem) -> str:
    """Which of the two tenants are erased, when nothing goes on any more: each is there with all it had, or gone."""
    await until(lambda: not system._homes.erasures.covers(ACME) and not system._homes.erasures.covers(OTHER))
    gone = 0
    for path in (ACME, OTHER):
        counted = await system.erase(path, dry_run=True)
        assert (counted.addresses, counted.children) in ((3, 2), (0, 0))
        gone += counted.addresses == 0
        assert counted.addresses or counted.events == 0
    return ("none", "one", "both")[gone]
