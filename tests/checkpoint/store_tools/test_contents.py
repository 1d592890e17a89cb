"""What a store says of its contents: counted per address, and exported without the classes of the program."""

from __future__ import annotations

import base64
import dataclasses
import datetime
import enum
import json
import os
import subprocess
import sys
import tracemalloc
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import holdfast as hf
from holdfast.checkpoint.journal import StoreFailed
from holdfast.checkpoint.sqlite import SqliteJournal
from holdfast.checkpoint.store_tools import export_store, store_stats
from tests.checkpoint.sqlite.stores import edit, end, inputs
from tests.checkpoint.store_tools.writing import acknowledged, begin_writing, environment, everything, filled, run
from tests.effects.patient import IN_TIME, Call, Go, patient

pytestmark = pytest.mark.usefixtures("warm_programs")

SEED = int(os.environ.get("HOLDFAST_SEED", "1"))


class Colour(enum.Enum):
    RED = 1


@dataclasses.dataclass(frozen=True)
class Place:
    x: int
    colour: Colour


class Item(hf.Message):
    name: str
    count: int = 1


class Order(hf.Message[int]):
    number: int
    items: tuple[Item, ...] = ()
    to: hf.ActorRef[Any] | None = None
    by_name: dict[str, Item] | None = None


class Shop(hf.Actor):
    def __init__(self, size: int) -> None:
        self.orders = 0
        self.text, self.data, self.when = "open", b"\xff", datetime.date(2026, 1, 2)
        self.places = {Place(1, Colour.RED)}
        self.by_number = {1: "one"}
        self.nothing, self.far = None, float("inf")
        self.numbers = np.arange(size)

    @hf.on(Order)
    def order(self, order: Order) -> int:
        self.orders += 1
        return order.number

    @hf.on(Item)
    def item(self, item: Item) -> None:
        self.ctx.stash()


async def shop(path: Path, size: int, orders: int = 5) -> None:
    async with hf.ActorSystem("app", store=f"sqlite:{path}.live", log=False) as system:
        shop = await system.start(hf.child("shop", hf.start(Shop, size), recovery=hf.hybrid(every=3)))
        for number in range(orders):
            await shop.ask(Order(number, (Item("nail", 7),), shop, {"one": Item("screw")}))
        shop.tell(Item("later"))
        await shop.ask(Order(orders))
        while store_stats(f"{path}.live").addresses[0].snapshots == []:
            await shop.ask(Order(orders))
        await system.backup(path)


class Receipt(hf.Message):
    total: int
    words: str


class Buy(hf.Message[Receipt]):
    first: int
    second: str


class Till(hf.Actor):
    @hf.on(Buy)
    def buy(self, message: Buy) -> Receipt:
        return Receipt(message.first * 2, message.second)


class Buyer(hf.Actor):
    def __init__(self, till: hf.ActorRef[Till]) -> None:
        self._till = till

    @hf.on(Order)
    async def order(self, order: Order) -> int:
        return (await self._till.ask(Buy(order.number, "please"))).total


async def test_replies_have_the_names_of_their_own_fields(tmp_path: Path) -> None:
    path = tmp_path / "app.db"
    async with hf.ActorSystem("app", store=f"sqlite:{path}", log=False) as system:
        till = await system.start(hf.child("till", hf.start(Till)))
        buyer = await system.start(hf.child("buyer", hf.start(Buyer, till), recovery=hf.hybrid()))
        assert await buyer.ask(Order(4)) == 8
        (got,) = of(list(export_store(path)), "got")
    assert got["value"] == {"total": 8, "words": "please"}
    assert (got["outcome"], got["type"]) == ("reply", f"{__name__}:Buy")


def of(records: list[dict[str, Any]], kind: str) -> list[dict[str, Any]]:
    return [record for record in records if record["record"] == kind]


@pytest.mark.parametrize("size", [3, 400_000])
async def test_an_export_has_states_and_messages_with_the_names_of_their_fields(tmp_path: Path, size: int) -> None:
    """Also where a state is so large that it lies in packs."""
    path = tmp_path / "app.db"
    await shop(path, size)
    before = everything(tmp_path)
    records = [json.loads(json.dumps(record, allow_nan=False)) for record in export_store(path)]
    assert everything(tmp_path) == before
    assert records[0]["record"] == "store"
    snapshot = of(records, "snapshot")[-1]
    assert (snapshot["address"], snapshot["class"], snapshot["schema_version"]) == ("/app/shop", f"{__name__}:Shop", 1)
    variables = snapshot["variables"]
    numbers = variables.pop("numbers")
    assert base64.b64decode(numbers["base64"]) == np.arange(size).tobytes()
    assert (numbers["dtype"], numbers["shape"]) == ("int64", [size])
    assert variables.pop("orders") == snapshot["turn"]
    place = {"x": 1, "colour": {"type": f"{__name__}:Colour", "value": "RED"}}
    assert variables == {
        "text": "open",
        "data": {"base64": "/w=="},
        "when": {"type": "datetime.date", "value": "2026-01-02"},
        "places": {"set": [{"type": f"{__name__}:Place", "fields": place}]},
        "by_number": {"pairs": [[1, "one"]]},
        "nothing": None,
        "far": {"float": "inf"},
    }
    messages = [record for record in of(records, "input") if record["type"] == f"{__name__}:Order"]
    whole = next(record["message"] for record in messages if record["message"]["items"])
    assert whole["items"] == [{"name": "nail", "count": 7}]
    assert whole["to"] == {"ref": "/app/shop"}
    assert whole["by_name"] == {"one": {"name": "screw", "count": 1}}
    assert not of(records, "damage")


async def test_the_classes_of_the_program_need_not_be_there(tmp_path: Path) -> None:
    path = tmp_path / "app.db"
    await shop(path, 3)
    here = [record for record in export_store(path) if record["record"] != "store"]
    script = """
import json, sys
from holdfast.checkpoint.store_tools import export_store

records = [record for record in export_store(sys.argv[1]) if record["record"] != "store"]
assert not any("test_contents" in name for name in sys.modules)
print(json.dumps(records))
"""
    command = [sys.executable, "-c", script, str(path)]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == json.loads(json.dumps(here))


async def test_the_numbers_of_an_address(tmp_path: Path) -> None:
    path = tmp_path / "app.db"
    await shop(path, 3)
    found = store_stats(path)
    (one,) = found.addresses
    assert (one.address, one.kind, one.damage) == ("/app/shop", f"{__name__}:Shop", "")
    assert one.turns >= 7
    assert one.waiting == 1  # It was put aside.
    assert one.snapshots[-1].turn <= one.turns
    assert one.snapshots[-1].size > 0
    assert one.snapshots[-1].time > 1e9
    live = store_stats(f"{path}.live")
    assert (found.origin, live.origin) == (live.identity, "")
    assert found.files.keys() == {"app.db", "app.db-snapshots"}
    with closing(SqliteJournal(path)) as journal:
        saved = journal.load("/app/shop")
        assert one.entries >= len(saved.entries)


def test_a_store_that_is_written_to_can_be_counted_and_exported(tmp_path: Path) -> None:
    path = tmp_path / "app.db"
    writer = begin_writing(path, SEED)
    try:
        for _ in range(4):
            before = acknowledged(writer, 30)
            found = store_stats(path)
            assert found.pid == writer.pid
            assert found.last >= before, f"seed {SEED}"
            assert not any(one.damage for one in found.addresses), f"seed {SEED}"
            records = list(export_store(path))
            assert records[0]["last"] >= found.last
            assert not of(records, "damage"), f"seed {SEED}: {of(records, 'damage')}"
    finally:
        end(writer)


def test_an_export_takes_the_memory_of_an_entry_not_of_the_store(tmp_path: Path) -> None:
    path = tmp_path / "app.db"
    with closing(SqliteJournal(path)) as journal:
        for number in range(20):
            entries = [
                ("/app/a", ("in", 250 * number + n, "message", "app:Note", b"x" * 2000, 0.0, None, ""))
                for n in range(250)
            ]
            journal.append(entries)
    assert os.path.getsize(path) > 10_000_000
    tracemalloc.start()
    try:
        count = sum(1 for _ in export_store(path))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert count == 5002
    assert peak < 2_000_000


def test_a_closed_store_that_is_opened_under_an_export_is_told(tmp_path: Path) -> None:
    path = filled(tmp_path / "app.db")
    records = export_store(path)
    assert next(records)["record"] == "store"
    with closing(SqliteJournal(path)) as journal:
        journal.append(inputs(500))
    with pytest.raises(StoreFailed, match="it was opened while it was exported"):
        list(records)


def test_the_commands(tmp_path: Path) -> None:
    path = filled(tmp_path / "app.db")
    status, said, _ = run("stats", path)
    assert status == 0
    assert "/app/bank/alice" in said
    assert "2 addresses" in said
    status, said, _ = run("stats", path, "--json")
    data = json.loads(said)
    assert (status, [one["address"] for one in data["addresses"]]) == (0, ["/app/bank/alice", "/app/bank/bob"])
    status, said, _ = run("export", path)
    assert (status, {"snapshot", "in"} <= {json.loads(line)["record"] for line in said.splitlines()}) == (0, True)
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "holdfast.console.cli", "store", "export", str(path)]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, timeout=60, check=False)
    assert done.returncode != 0
    assert done.stderr.startswith("holdfast store export: the output cannot be written: [Errno 28] No space left")
    edit(path, "UPDATE entries SET crc = 0 WHERE position = 6")
    assert run("stats", path)[0] == 1
    status, said, _ = run("export", path)
    assert (status, of([json.loads(line) for line in said.splitlines()], "damage")[0]["position"]) == (1, 6)
    edit(path, "DELETE FROM store")
    for name in ("stats", "export"):
        assert run(name, path)[0] == 1
        assert run(name, tmp_path / "nothing.db")[0] == 2


async def test_what_effects_and_waits_have_come_to_is_exported_with_its_time(tmp_path: Path) -> None:
    path = tmp_path / "app.db"
    async with hf.ActorSystem("app", store=f"sqlite:{path}", log=False) as system:
        ref = await system.start(patient(recovery=hf.replay_only()))
        asked = ref.ask(Go(["e", "s0", "c"], str(tmp_path / "world")), IN_TIME)
        await ref.ask(Call("hello"), IN_TIME)
        await asked
    got = [one for one in export_store(path) if one["record"] == "got"]
    assert [(one["outcome"], one["value"]) for one in got] == [
        ("reply", 1),
        ("moment", None),
        ("message", {"word": "hello"}),
    ]
    assert all(one["time"] > 1e9 for one in got)
    assert [one["record"] for one in export_store(path) if one["record"] == "due"] == ["due", "due"]
