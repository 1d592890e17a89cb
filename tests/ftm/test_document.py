"""What the pages about mechanisms say, against declarations and real runs."""

from __future__ import annotations

import asyncio
import dataclasses
import importlib
import inspect
import os
import pkgutil
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
import holdfast.ftm
from holdfast.console.endpoint import control_endpoint
from holdfast.ftm.model.change_model import label
from holdfast.ftm.model.coverage import coverage, selection_table
from holdfast.ftm.model.mechanism import BUILT_IN, MechanismRefused, find, load
from holdfast.ftm.model.mechanism_declaration import FAULTS, NEEDS
from holdfast.ftm.sec import sec_errors as sec_errors
from tests.ftm.accounts import Add, Closed, Counter, Load, Tags

pytestmark = pytest.mark.usefixtures("warm_programs")

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "mechanisms.md").read_text("utf-8")
FAILOVER = (ROOT / "docs" / "failover.md").read_text("utf-8")
TROUBLE = (ROOT / "docs" / "mechanisms-trouble.md").read_text("utf-8")
SCRIPT = ROOT / "examples" / "scripts" / "protect.py"
AUDIT_TRAIL = ROOT / "examples" / "mechanisms" / "audit_trail.py"


def rows(corner: str, text: str = TEXT) -> dict[str, list[str]]:
    """The table with this text in its first cell: first cell of each row to the others."""
    found = re.search(rf"^\| {corner} \|.*\n\|[-|]+\|\n(?:\|.*\n)+", text, re.M)
    assert found, corner
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in found[0].splitlines()[2:]]
    return {first.strip("`"): rest for first, *rest in cells}


def test_what_mechanisms_declare() -> None:
    """A26, A27."""
    table = rows("mechanism")
    for one in coverage().entries:
        tolerates = ", ".join(name for name in FAULTS if name in one.tolerates)
        needs = ", ".join(name for name in NEEDS if name in one.needs)
        said = [tolerates, needs, str(one.replicas), one.bandwidth, one.cpu, one.layer]
        assert table[one.name] == said, one.name
    assert set(BUILT_IN) <= set(table)


def test_what_is_chosen() -> None:
    """A19."""
    names = re.search(r"<!-- selection: (.*) -->", TEXT)
    assert names
    found = selection_table([find(name) for name in names[1].split()])
    text = re.search(r"^\| faults \|.*\n\|[-|]+\|\n((?:\|.*\n)+)", TEXT, re.M)
    assert text
    said = [[cell.strip() for cell in line.strip("|").split("|")] for line in text[1].splitlines()]
    assert said == [
        [
            str(one.faults),
            "yes" if one.application.is_deterministic else "no",
            "yes" if one.application.has_state_access else "no",
            label(one.best.layers),
        ]
        for one in found
        if one.best
    ]


def test_how_replicas_are_watched() -> None:
    table = rows("setting", FAILOVER)
    said = {name: None if cells[0] == "none" else float(cells[0]) for name, cells in table.items()}
    assert said == dataclasses.asdict(hf.ftm.Detection())


async def test_the_graph_as_it_is_shown(system: hf.ActorSystem) -> None:
    block = re.search(r"```text\n(/app/bank/alice .*?)```", TEXT, re.S)
    assert block
    said = {line.split()[0] for line in block[1].splitlines()}
    bank = hf.supervisor("bank", children=[hf.child("alice", hf.start(Counter), mechanism=hf.ftm.PBR())])
    await system.start(bank)
    shown = [path for path in system.tree() if path.startswith("/app/bank/alice")]
    second = {path.replace("/r1", "/r2") for path in said if "/r1/" in path}
    assert sorted(shown) == sorted(said | second)
    ftm = "/app/bank/alice/ftm"
    for owner, port, target in (
        ("proxy", "protocol", "r1/protocol"),
        ("r1/protocol", "before", "r1/before"),
        ("r1/before", "next", "r1/proceed"),
        ("r1/proceed", "next", "r1/after"),
        ("r1/proceed", "server", "r1/server"),
        ("r1/after", "next", "r1/protocol"),
        ("r1/protocol", "next", "proxy"),
    ):
        status = await system.get_status(system.ref(f"{ftm}/{owner}", hf.Actor))
        assert status.bindings[port] == f"{ftm}/{target}"


async def test_the_steps_of_a_failover(system: hf.ActorSystem) -> None:
    """A57-A59, T1."""
    ref: Any = await system.start(hf.child("c", hf.start(Counter), mechanism=hf.ftm.PBR()))
    steps: list[str] = []
    ref._cell.host.place.on_step = steps.append
    load = Load(ref)
    await load.reached(20)
    os.kill(system.pid_of(system.ref("/app/c/ftm/r1", hf.Actor)), signal.SIGKILL)
    await load.reached(20)
    await load.stop()
    load.check(await ref.ask(Tags()))
    assert steps[:5] == list(rows("step", FAILOVER))


async def test_the_mechanism_of_the_example_runs_from_its_file(system: hf.ActorSystem, tmp_path: Path) -> None:
    """Each request stands in the file before it was computed and after, whoever leads."""
    kind: Any = load(AUDIT_TRAIL)
    file = tmp_path / "audit.log"
    ref = await system.start(hf.child("c", hf.start(Counter)))
    async with system.transaction() as change:
        change.protect(ref, (kind(str(file)), hf.ftm.PBR()))
    clients = Load(ref)
    await clients.reached(50)
    os.kill(system.pid_of(system.ref("/app/c/ftm/r1", hf.Actor)), signal.SIGKILL)
    await clients.reached(50)
    await clients.stop()
    clients.check(await ref.ask(Tags()))
    lines = file.read_text("utf-8").splitlines()
    asked = [int(line.split()[0]) for line in lines if " Add " in line]
    ended = [int(line.split()[0]) for line in lines if line.endswith(" is ok")]
    assert len(set(asked)) == clients.sent
    assert set(asked) <= set(ended)
    first = {number: lines.index(f"{number} is ok") for number in set(asked)}
    assert all(lines.index(f"{number} Add from ") < at for number, at in first.items())


async def test_the_script_of_the_example_is_applied_from_another_process(
    system: hf.ActorSystem, tmp_path: Path
) -> None:
    """A76, A80, A81."""
    await system.start(hf.supervisor("bank", children=[hf.child("alice", hf.start(Counter))]))
    alice = system.ref("/app/bank/alice", Counter)
    assert await alice.ask(Add(0)) == 1
    async with control_endpoint(system, tmp_path / "app.sock") as socket:
        command = (sys.executable, "-m", "holdfast.console.cli", "apply", SCRIPT, "--socket", socket)
        for more, mechanism in (("--dry-run",), None), ((), hf.ftm.LFR()):
            process = await asyncio.create_subprocess_exec(*map(str, (*command, *more)), stdout=subprocess.PIPE)
            output, _ = await process.communicate()
            assert process.returncode == 0
            lines = [line for line in output.decode().splitlines() if " by " in line]
            assert [line.partition(" by ")[2] for line in lines[:4]] == [
                "PBR", "PBR + TR", "LFR + TR", "LFR",
            ]  # fmt: skip
            assert alice._cell.spec.mechanism == mechanism
    assert await alice.ask(Add(1)) == 2


def modules() -> list[Any]:
    """All of holdfast.ftm, and what keeps mechanisms over a restart of the root."""
    names = [one.name for one in pkgutil.walk_packages(holdfast.ftm.__path__, "holdfast.ftm.")]
    return [importlib.import_module(name) for name in [*names, "holdfast.system.mechanism_notes"]]


def defined(base: type) -> set[str]:
    return {
        name
        for module in modules()
        for name, value in inspect.getmembers(module, inspect.isclass)
        if issubclass(value, base) and value.__module__ == module.__name__ and not name.startswith("_")
    }


@pytest.mark.parametrize("base", [hf.events.Event, hf.HoldfastError, hf.Refusal], ids=lambda base: base.__name__)
def test_everything_that_can_be_said_is_explained(base: type) -> None:
    assert defined(base)
    missing = {name for name in defined(base) if f"`{name}`" not in TROUBLE}
    assert not missing


def test_each_reason_of_a_rejection_is_explained() -> None:
    table = TROUBLE[TROUBLE.index("| `Rejected.reason`") :]
    reasons = {value for key, value in vars(sec_errors).items() if key.isupper() and not key.startswith("_")}
    assert not {reason for reason in reasons if f"`{reason}`" not in table}


REFUSED: dict[str, Callable[[Any], None]] = {
    "it has no mechanism yet: protect it first": lambda change: change.update("/app/plain", "after", hf.ftm.After),
    "not inside": lambda change: change.protect("/app/c", (hf.ftm.TR(), hf.ftm.PBR())),
    "keeps replicas already": lambda change: change.protect("/app/c", ("pbr", hf.ftm.LFR())),
    "it stands in the composition twice": lambda change: change.protect(
        "/app/c", (hf.ftm.PBR(), hf.ftm.TR(), hf.ftm.TR())
    ),
    "a supervisor cannot be protected": lambda change: change.protect("/app/family", hf.ftm.PBR()),
    "there is no mechanism of that name": lambda change: change.protect("/app/c", "none"),
    "`state_access = False`": lambda change: change.protect("/app/closed", hf.ftm.PBR()),
}


async def test_refusals_say_what_the_document_says(system: hf.ActorSystem) -> None:
    """T39, T42."""
    await system.start(hf.child("c", hf.start(Counter), mechanism=hf.ftm.PBR()))
    await system.start(hf.child("plain", hf.start(Counter)))
    await system.start(hf.child("closed", hf.start(Closed)))
    await system.start(hf.supervisor("family", children=[]))
    for text, wish in REFUSED.items():
        assert text in TROUBLE
        with pytest.raises(hf.TransactionRefused) as refused:
            async with system.transaction() as change:
                wish(change)
        assert text.strip("`") in str(refused.value)
    with pytest.raises(MechanismRefused, match="state_access = False"):
        hf.child("x", hf.start(Closed), mechanism=hf.ftm.PBR())
    assert await system.ref("/app/c", Counter).ask(Add(1)) == 1


CITED = re.compile(r"\bA(\d+)(?:-A(\d+))?\b")


def test_what_tests_cite_of_the_paper_is_listed_and_what_is_listed_is_cited() -> None:
    """A range cites all in it."""
    listed = set(re.findall(r"^\| (A\d+) \|", (ROOT / "docs" / "requirements.md").read_text("utf-8"), re.MULTILINE))
    cited: set[str] = set()
    for path in (ROOT / "tests").rglob("*.py"):
        for first, last in CITED.findall(path.read_text("utf-8")):
            cited.update(f"A{number}" for number in range(int(first), int(last or first) + 1))
    assert listed == cited
