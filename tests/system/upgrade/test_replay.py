"""`holdfast replay`: the recorded turns of one actor one by one, its state after any of them, and a debugger in one."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from tests.checkpoint.store_tools.writing import everything
from tests.system.upgrade.shops import SHOP, killed, newer, replay

pytestmark = pytest.mark.usefixtures("warm_programs")

ALICE, LEDGER = "/app/bank/alice", "/app/ledger"
SPEC = ("--spec", "shop:tree")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Snapshots after turns 3 and 6 of Alice, eight turns in all."""
    return killed(tmp_path_factory.mktemp("old"))


def test_each_turn_is_shown_and_the_state_after_the_last_one(store: Path) -> None:
    before = everything(store.parent)
    status, said, errors = replay(store, store.parent, ALICE, *SPEC, "--from", "4", "--until", "5")
    assert (status, errors) == (0, "")
    lines = re.sub(r", \d{4}-\d\d-\d\d \d\d:\d\d:\d\d", "", said).splitlines()
    assert lines == [
        'turn 4: shop:Pay {"cents": 40, "memo": "m4"}',
        "    replies 196",
        "    output 1: ask /app/ledger shop:Rate {} after 5 s and got 1",
        '    output 2: tell /app/ledger shop:Note {"text": "m4"}',
        "    balance: 157 -> 196",
        '    memos: ["m1", "m2", "m3"] -> ["m1", "m2", "m3", "m4"]',
        'turn 5: shop:Pay {"cents": 50, "memo": "m5"}',
        "    replies 245",
        "    output 1: ask /app/ledger shop:Rate {} after 5 s and got 1",
        '    output 2: tell /app/ledger shop:Note {"text": "m5"}',
        "    balance: 196 -> 245",
        '    memos: ["m1", "m2", "m3", "m4"] -> ["m1", "m2", "m3", "m4", "m5"]',
        "/app/bank/alice after turn 5 of 8:",
        "    balance = 245",
        '    memos = ["m1", "m2", "m3", "m4", "m5"]',
        '    ledger = {"ref": "/app/ledger"}',
    ]
    assert everything(store.parent) == before


def test_a_turn_that_waits_is_shown_as_far_as_it_has_come(store: Path) -> None:
    status, said, errors = replay(store, store.parent, "/app/trip", *SPEC)
    assert (status, errors) == (0, "")
    lines = re.sub(r", \d{4}-\d\d-\d\d \d\d:\d\d:\d\d", "", said).splitlines()
    assert lines[2:] == [
        "turn 1: shop:Book {}",
        "    in hand",
        '    output 1: effect done and got "seat"',
        "    output 2: pipe",
        "    output 3: timer 1.3 shop:Go {} after 3600 s",
        "    output 4: wait shop:Go and waits for it",
        '    seen: [] -> ["seat"]',
        "/app/trip after turn 0 of 0:",
        "    seen = []",
    ]
    _, said, _ = replay(store, store.parent, "/app/trip", *SPEC, "--until", "0")
    assert "turn 1" not in said


def test_the_state_after_each_kept_turn_can_be_had(store: Path) -> None:
    balances = []
    for turn in range(3, 9):
        status, said, _ = replay(store, store.parent, ALICE, *SPEC, "--until", str(turn), "--json")
        found = json.loads(said)
        assert (status, found["turn"], found["kept_from"], found["last"]) == (0, turn, 3, 8)
        balances.append(found["state"]["balance"])
        assert [one["turn"] for one in found["turns"]] == list(range(4, turn + 1))
    assert balances == [157, 196, 245, 304, 373, 452]


def test_a_recorded_class_is_found_by_its_name_if_it_takes_no_arguments(store: Path, tmp_path: Path) -> None:
    status, said, _ = replay(store, newer(tmp_path), LEDGER, "--until", "1")
    assert (status, said.splitlines()[-1]) == (0, '    lines = ["trip"]')
    bare = newer(tmp_path / "bare", ("balance: int = 0", "balance: int"))
    status, _, errors = replay(store, bare, ALICE)
    assert status == 2
    assert "shop:Account cannot be started without arguments" in errors
    assert "name the specs of its program with --spec" in errors


def test_code_that_goes_another_way_ends_the_replay_there(store: Path, tmp_path: Path) -> None:
    code = newer(tmp_path, ("        return self.balance\n", "        return self.balance + (message.cents == 70)\n"))
    status, said, _ = replay(store, code, ALICE, *SPEC)
    assert status == 1
    assert "\nturn 6: " in said
    assert "\nturn 7: " not in said
    assert said.splitlines()[-1].startswith(f"ended early: replay of {ALICE} diverged at turn 7: the reply to shop:Pay")


def test_the_debugger_stops_before_the_handler_of_the_turn(store: Path) -> None:
    keys = "p message.cents\np self.balance\nnext\nnext\nc\n"
    status, said, _ = replay(store, store.parent, ALICE, *SPEC, "--from", "8", "--until", "8", "--break", keys=keys)
    assert status == 0
    line = next(number for number, one in enumerate(SHOP.splitlines(), 1) if "ledger = self.ctx.find" in one)
    assert f"shop.py({line})pay()\n-> ledger = self.ctx.find" in said
    assert "(Pdb) 80\n(Pdb) 373\n(Pdb) " in said
    assert said.endswith(
        '    memos = ["m1", "m2", "m3", "m4", "m5", "m6", "m7", "m8"]\n    ledger = {"ref": "/app/ledger"}\n'
    )
    assert replay(store, store.parent, ALICE, *SPEC, "--break", keys="q\n")[0] == 1


def test_long_values_are_cut(store: Path, tmp_path: Path) -> None:
    code = newer(tmp_path, ("self.memos.append(message.memo)", 'self.memos.append(message.memo); self.x = "y" * 300'))
    _, said, _ = replay(store, code, ALICE, *SPEC, "--until", "4")
    assert f'    x = "{"y" * 200}... (300 characters)"' in said.splitlines()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("/app/none",), "nothing is recorded of it; the store has /app/bank/alice, /app/ledger,"),
        ((ALICE, *SPEC, "--until", "9"), "there is no turn 9: turns up to 3 are only in a snapshot, and the last one"),
        ((ALICE, *SPEC, "--until", "2"), "there is no turn 2: turns up to 3 are only in a snapshot"),
        ((ALICE, "--spec", "shop:none"), "shop has no none"),
        ((LEDGER, "--spec", "shop:none"), "shop has no none"),
        ((ALICE, "--spec", "shop:two"), "the new program starts nobody there"),
    ],
)
def test_what_cannot_be_replayed_is_refused_in_words(
    arguments: tuple[str, ...], said: str, store: Path, tmp_path: Path
) -> None:
    code = newer(tmp_path, ("SLOW = ", "two = []\nSLOW = "))
    status, out, errors = replay(store, code, *arguments)
    assert (status, out) == (2, "")
    assert errors.startswith("holdfast replay: ")
    assert said in errors
    assert errors.count("\n") == 1


def test_a_thousand_turns_from_the_start_to_any_of_them(tmp_path: Path) -> None:
    store = killed(tmp_path, TURNS="1000")
    status, said, _ = replay(store, tmp_path, LEDGER, "--until", "1000", "--from", "999", "--json")
    found = json.loads(said)
    assert (status, found["kept_from"], found["turn"]) == (0, -1, 1000)
    assert [one["turn"] for one in found["turns"]] == [999, 1000]
    status, said, _ = replay(store, tmp_path, ALICE, *SPEC, "--until", "1000", "--from", "1000", "--json")
    assert json.loads(said)["state"]["balance"] == 100 + 10 * 500_500 - 1000
