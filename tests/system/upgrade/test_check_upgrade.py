"""`holdfast check-upgrade`: new code handles again what an old program has recorded, and every difference is told."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from tests.checkpoint.store_tools.writing import everything
from tests.system.upgrade.shops import SESSIONS, begin, check, environment, killed, newer, replay

pytestmark = pytest.mark.usefixtures("warm_programs")

ALICE, LEDGER, TRIP, SEARCH, ROOM = "/app/bank/alice", "/app/ledger", "/app/trip", "/app/search", "/app/rooms/one"
ALL = {ALICE, LEDGER, TRIP, SEARCH, ROOM}


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Snapshots after turns 3 and 6 of Alice, eight turns in all; a trip that waits; a search that is not over."""
    return killed(tmp_path_factory.mktemp("old"))


class Change(NamedTuple):
    """A change of the code, and what is said of which address."""

    old: str
    new: str
    address: str
    verdict: str
    turn: int
    problem: str


PAID = "        self.memos.append(message.memo)\n"
CHANGES = {
    "another reply": Change(
        "return self.balance", "return self.balance + 1", ALICE, "differs", 4, "the reply to shop:Pay is not what"
    ),
    "one more output": Change(
        "        return self.balance\n", "        ledger.tell(Note(''))\n        return self.balance\n",
        ALICE, "differs", 4, "output 3 (tell of shop:Note to /app/ledger) is not",
    ),
    "an output less": Change("        ledger.tell(Note(message.memo))\n", "", ALICE, "differs", 4, "output 2 is not"),
    "another state": Change(
        PAID, PAID * 2, ALICE, "differs", 6, "memos was ['m1', 'm2', 'm3', 'm4', 'm5', 'm6'], now it is ['m1', 'm2', "
    ),
    "a variable less": Change(
        "        self.memos: list[str] = []\n", "", ALICE, "differs", 4, "no attribute 'memos'"
    ),
    "a variable of another name": Change("memos", "texts", ALICE, "refused", -1, "memos would be lost"),
    "it raises": Change(PAID, PAID + "        1 / 0\n", ALICE, "differs", 4, "handling it again raised"),
    "no handler": Change("    @hf.on(Note)\n", "", LEDGER, "differs", -2, "it cannot be handled any more"),
    "another class": Change("Account", "Konto", ALICE, "refused", -1, "it was recorded by shop:Account"),
    "a field that nothing is known of": Change(
        "    cents: int\n    memo: str", "    why: str\n    cents: int\n    memo: str", ALICE, "refused", -1, "why"
    ),
    "no such address": Change('hf.child("alice"', 'hf.child("bob"', ALICE, "missing", -1, "starts nobody there"),
    "no recovery": Change(
        'isolation="process", recovery=SLOW', 'isolation="process"',
        ALICE, "refused", -1, "starts it without a recovery method",
    ),
    "it exits": Change(
        PAID, PAID + "        os._exit(message.cents)\n", ALICE, "differs", 4, "process has ended with status 40"
    ),
    "it hangs": Change(
        PAID, PAID + "        while True: pass\n", ALICE, "differs", 4, "process has not come to an end within 2 s"
    ),
    "it waits for ever": Change(
        PAID, PAID + "        await asyncio.Event().wait()\n", ALICE, "differs", 4, "not come to an end within 2 s"
    ),
    "an effect less": Change(
        'await self.ctx.effect(done, "seat")', '"seat"', TRIP, "differs", 1, "output 1 (pipe) is not"
    ),
    "a turn in hand that raises": Change(
        "        self.ctx.tell_after(", "        1 / 0\n        self.ctx.tell_after(",
        TRIP, "differs", 1, "ZeroDivisionError",
    ),
    "a room": Change(
        "        self.lines.append(message.text)\n", "        self.lines.append(self.none)\n",
        ROOM, "differs", 1, "AttributeError",
    ),
    "its start raises": Change(
        "        self.balance = balance\n", "        raise ValueError('no')\n", ALICE, "refused", -1, "ValueError: no"
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CHANGES)
@pytest.mark.some(10)
def test_a_change_is_told_with_its_turn_and_the_others_are_checked(
    name: str, store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old, new, address, verdict, turn, problem = CHANGES[name]
    before = everything(store.parent)
    code = newer(tmp_path, (old, new))
    limit = ("--turn-timeout", "2") if "within 2 s" in problem else ()
    status, found, _ = check(monkeypatch, store, code, *limit)
    assert found.keys() == ALL
    one = found[address]
    assert one["verdict"] == verdict, one
    assert problem in one["problem"]
    if turn >= -1:
        assert one["turn"] == turn
    assert status == (verdict != "fine")
    others = {one["verdict"] for one in found.values() if one["address"] not in (address, ROOM, LEDGER)}
    assert others == {"fine"}
    assert everything(store.parent) == before  # Neither the store nor the effects of the program.


@pytest.mark.parametrize(
    "change",
    [
        ("", ""),
        ('    memo: str = ""\n', '    memo: str = ""\n    why: str = ""\n'),
        ('    cents: int\n    memo: str = ""\n', '    memo: str = ""\n    cents: int = 0\n'),
        ("        self.memos: list[str] = []\n", "        self.memos: list[str] = []\n        self.more = 1\n"),
        ('self.seen.append("gone")', 'self.seen.append("left")'),
    ],
    ids=["none", "a field at the end", "fields in another order", "one more variable", "behind the wait"],
)
def test_what_goes_on_as_before_is_fine(
    change: tuple[str, str], store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = everything(store.parent)
    status, found, errors = check(monkeypatch, store, newer(tmp_path, change))
    assert (status, errors) == (0, "")
    assert {one["verdict"] for one in found.values()} == {"fine"}
    turns = {address: one["turns"] for address, one in found.items()}
    assert turns == {ALICE: 5, LEDGER: 18, TRIP: 1, SEARCH: 2, ROOM: 2}
    assert found[TRIP]["note"] == "turn 1 has no end, and is checked as far as it had come"
    assert everything(store.parent) == before


def test_a_variable_that_was_renamed_is_fine(store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its states are compared under the names that they have now."""
    renamed = ("class Account(", '@hf.renamed(texts="memos")\nclass Account(')
    status, found, errors = check(monkeypatch, store, newer(tmp_path, ("memos", "texts"), renamed))
    assert (status, errors, found[ALICE]["verdict"]) == (0, "", "fine")


def test_a_hook_that_waits_for_others_cannot_be_checked(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hook = "    async def on_start(self, restored: bool) -> None:\n        await self.ctx.effect(done, 'hook')\n\n"
    code = newer(tmp_path, ("    @hf.on(Pay)\n", f"{hook}    @hf.on(Pay)\n"))
    before = everything(store.parent)
    status, found, _ = check(monkeypatch, store, code)
    assert status == 2
    assert found[ALICE]["verdict"] == "unchecked"
    assert "start of /app/bank/alice waits for effect done" in found[ALICE]["problem"]
    assert everything(store.parent) == before


def test_an_address_can_be_named_that_the_program_starts_later(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    later = '\n\ndef later():\n    return [*tree[:1], *tree[2:], {"/app/bank/alice": tree[1].below().__next__()}]\n'
    code = newer(tmp_path, ("async def main", f"{later}\n\nasync def main"))
    status, found, _ = check(monkeypatch, store, code, spec="shop:later")
    assert (status, set(found)) == (0, ALL)


def test_a_store_that_a_system_has_open_is_checked_and_a_state_put_in_place_is_no_difference(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with begin(tmp_path / "old", "waits") as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "up\n"
        status, found, _ = check(monkeypatch, tmp_path / "old" / "app.db", newer(tmp_path / "new"))
        said, _ = process.communicate("go on\n", timeout=60.0)
    assert (status, set(found)) == (0, ALL)
    assert said == "79\n"


def test_a_program_that_is_a_script_is_named_by_its_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store, code = killed(tmp_path / "old", script=True), newer(tmp_path / "new")
    assert check(monkeypatch, store, code, spec="shop.py:tree")[0] == 0
    status, found, _ = check(monkeypatch, store, code)
    assert status == 1
    assert "it was recorded by __main__:Account" in found[ALICE]["problem"]


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        ("tree", "name the specs as 'module:name' or 'program.py:name'"),
        ("shopping:tree", "No module named 'shopping'"),
        ("shop:trees", "shop has no trees"),
        ("shop:SHOP", "shop has no SHOP"),
        ("shop:DONE", "it must be a spec, some specs, or a function that returns them"),
        ("broken:tree", "ValueError: not today"),
        ("exits:tree", "its process has ended with status 7"),
        ("raises:tree", "it raised ValueError: no tree"),
    ],
)
def test_specs_that_cannot_be_had_are_refused_in_words(
    spec: str, said: str, store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = newer(tmp_path)
    (code / "broken.py").write_text("raise ValueError('not today')\n")
    (code / "exits.py").write_text("import os\nos._exit(7)\n")
    (code / "raises.py").write_text("def tree():\n    raise ValueError('no tree')\n")
    status, found, errors = check(monkeypatch, store, code, spec=spec)
    assert (status, found) == (2, {})
    assert errors.startswith("holdfast check-upgrade: ")
    assert said in errors
    assert errors.count("\n") == 1


@pytest.mark.parametrize(
    ("change", "verdict", "status"), [("", "fine", 0), ("return 'later'", "differs", 1)], ids=["same", "other"]
)
def test_children_that_sleep_are_checked_by_their_template_and_those_that_have_ended_are_no_difference(
    change: str, verdict: str, status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = tmp_path / "code"
    code.mkdir()
    (code / "sessions.py").write_text(SESSIONS)
    run = "import asyncio, sys, sessions; asyncio.run(sessions.main(sys.argv[1]))"
    store = tmp_path / "app.db"
    subprocess.run(
        [sys.executable, "-c", run, str(store)], check=True, cwd=code, env=environment(tmp_path), timeout=60.0
    )
    (code / "sessions.py").write_text(SESSIONS.replace("return 'bye'", change or "return 'bye'"))
    ended, found, _ = check(monkeypatch, store, code, spec="sessions:tree")
    verdicts = {address: one["verdict"] for address, one in found.items()}
    assert verdicts == {"/app/rooms/ann": "ended", "/app/sleeping/ann": verdict}
    assert ended == status
    assert "/app/rooms has forgotten it" in found["/app/rooms/ann"]["problem"]


GIVEN = """
import asyncio, dataclasses, sys

import holdfast as hf


@dataclasses.dataclass
class Seat:
    row: int


class Leave(hf.Message): ...


class Guest(hf.Actor):
    def __init__(self, seat: object) -> None:
        self.seat = seat

    @hf.on(Leave)
    def leave(self, message: Leave) -> None: ...


guest = hf.child(None, hf.start(Guest), recovery=hf.hybrid())
tree = [hf.dynamic("rooms", template=guest, journal=True)]


async def main() -> None:
    async with hf.ActorSystem("app", store=f"sqlite:{sys.argv[1]}", log=False) as system:
        rooms = await system.start(tree[0])
        for name, given in (("ann", Seat(3)), ("bob", 4)):
            one = await rooms.ask(hf.StartChild(args=(given,), id=name))
            await one.ask(Leave())
"""


def test_a_child_whose_own_arguments_newer_code_cannot_read_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, store = tmp_path / "code", tmp_path / "app.db"
    code.mkdir()
    (code / "given.py").write_text(GIVEN)
    run = "import asyncio, given; asyncio.run(given.main())"
    subprocess.run(
        [sys.executable, "-c", run, str(store)], check=True, cwd=code, env=environment(tmp_path), timeout=60.0
    )
    (code / "given.py").write_text(GIVEN.replace("Seat", "Place"))
    status, found, _ = check(monkeypatch, store, code, spec="given:tree")
    assert {address: one["verdict"] for address, one in found.items()} == {
        "/app/rooms/ann": "refused",
        "/app/rooms/bob": "fine",
    }
    assert "would not be started, since what is noted of it cannot be read" in found["/app/rooms/ann"]["problem"]
    assert "given:Seat" in found["/app/rooms/ann"]["problem"]
    assert status == 1


def test_a_store_that_cannot_be_read_is_refused_in_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = newer(tmp_path)
    (tmp_path / "app.db").write_bytes(b"no store" * 1000)
    for name in ("app.db", "none.db"):
        status, _, errors = check(monkeypatch, tmp_path / name, code)
        assert status == 2
        assert errors.startswith(f"holdfast check-upgrade: store {tmp_path / name} ")


def test_the_children_of_whom_their_supervisor_was_given_another_template_are_checked_by_that(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, store = "from tests.supervision import changes_player; changes_player.main()", tmp_path / "app.db"
    given = [f"sqlite:{store}", "template", "template, orders", "process"]
    old = subprocess.run([sys.executable, "-c", run, *given], env=environment(tmp_path), timeout=60.0)
    assert old.returncode == -9
    ended, found, _ = check(monkeypatch, store, tmp_path, spec="tests.supervision.changes_player:of_template")
    assert {address: one["verdict"] for address, one in found.items()} == {
        f"/app/{name}": "fine" for name in ("team/one", "team/two", "team/three", "others/guest")
    }
    assert ended == 0


MAP = """
import holdfast as hf
import numpy as np


class Put(hf.Message[int]):
    at: int


class Grid(hf.Actor):
    def __init__(self) -> None:
        self.cells = np.zeros((1000, 400), np.float32)
        self.count = 0

    @hf.on(Put)
    def put(self, message: Put) -> int:
        self.cells[message.at] += 1
        self.count += 1
        return self.count


def tree(isolation="task"):
    return hf.child("grid", hf.start(Grid), isolation=isolation, recovery=hf.hybrid(interval=3600.0))
"""
MAPPED = """
import asyncio, sys
import holdfast as hf
from grid import Put, tree


async def main(store: str, isolation: str, snapshots: int) -> None:
    async with hf.ActorSystem("app", store=store, log=False) as system:
        grid = await system.start(tree(isolation))
        for n in range(snapshots):
            await grid.ask(Put(n))
            await system.checkpoint(grid)
        await grid.ask(Put(snapshots))


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], sys.argv[2], int(sys.argv[3])))
"""


@pytest.mark.parametrize(("isolation", "snapshots"), [("task", 1), ("process", 3)])
def test_a_state_whose_snapshots_are_kept_in_blocks_is_checked_and_replayed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, isolation: str, snapshots: int
) -> None:
    (tmp_path / "grid.py").write_text(MAP)
    (tmp_path / "mapped.py").write_text(MAPPED)
    store = tmp_path / "app.db"
    command = [sys.executable, str(tmp_path / "mapped.py"), f"sqlite:{store}", isolation, str(snapshots)]
    subprocess.run(command, check=True, env=environment(tmp_path), timeout=60.0)
    status, found, errors = check(monkeypatch, store, tmp_path, spec="grid:tree")
    assert (status, errors) == (0, "")
    assert found["/app/grid"]["verdict"] == "fine"
    status, said, _ = replay(store, tmp_path, "/app/grid", "--spec", "grid:tree")
    assert status == 0
    assert f"    count = {snapshots + 1}" in said
