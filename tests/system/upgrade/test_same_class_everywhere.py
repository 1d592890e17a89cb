"""The next start of a program, `check_upgrade` and `replay_actor` see one class in what transactions have changed."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from holdfast import StartFailed
from holdfast.system.upgrade import ReplayedState, check_upgrade, replay_actor
from tests.system.upgrade.shops import environment

pytestmark = pytest.mark.usefixtures("warm_programs")

CHANGED = """
import asyncio
import json
import os
import signal
import sys

import holdfast as hf


class Add(hf.Message): ...


class Go(hf.Message): ...


class Dry(hf.Message): ...


class Seen(hf.Message[tuple[str, int]]): ...


class One(hf.Actor):
    other: hf.Binding[hf.Actor]
    step = 1

    def __init__(self) -> None:
        self.count = 0

    @hf.on(Add)
    def add(self, message: Add) -> None:
        self.count += self.step

    @hf.on(Go)
    async def go(self, message: Go) -> None:
        self.count += self.step
        await self.ctx.wait_for(Dry)

    @hf.on(Dry)
    def dry(self, message: Dry) -> None: ...

    @hf.on(Seen, readonly=True)
    def seen(self, message: Seen) -> tuple[str, int]:
        return type(self).__name__, self.count


class Two(One):
    step = 100


class Stranger(One): ...


RECORDS = hf.hybrid(interval=1000.0)
CHANGES = ("code", "template", "state", "unfit", "isolation", "move", "protect", "bind")
MOMENTS = [("waits", "none"), ("waits", "before"), ("waits", "within"), ("rests", "before"), ("rests", "after")]
ROWS = [
    (change, *moment)
    for change in os.environ.get("CHANGES", " ".join(CHANGES)).split()
    for moment in MOMENTS
    if change != "move" or moment[0] == "rests"  # A turn that waits keeps its actor where it is.
    if change in CHANGES[:4] or moment[1] == "before" or "HOLDFAST_CROSSED" in os.environ
]


def template(kind):
    return hf.child(None, hf.start(kind), recovery=RECORDS)


def child(row):
    kind = Stranger if row[0] == "unfit" and "AGAIN" in os.environ else One
    return hf.child("-".join(row), hf.start(kind), recovery=RECORDS)


def tree():
    return [
        hf.supervisor("annex", children=[]),
        hf.supervisor("moves", children=[child(row) for row in ROWS if row[0] == "move"]),
        hf.child("other", hf.start(One), recovery=RECORDS),
        hf.dynamic("given", template=template(One), journal=True),
        *[child(row) for row in ROWS if row[0] not in ("template", "move")],
    ]


async def changed(system, ref, kind) -> None:
    async with system.transaction() as change:
        match kind:
            case "code" | "template":
                change.replace_code(ref, Two)
            case "state":
                change.replace_state(ref, lambda state: {**state, "count": 1000})
            case "isolation":
                change.isolation(ref, "process")
            case "move":
                change.move(ref, "/app/annex")
            case "protect":
                change.protect(ref, hf.ftm.TR())
            case "bind":
                change.bind(ref, "other", "/app/other")


async def lived(system, ref, kind, turn, snapshot) -> None:
    ref.tell(Add())
    if snapshot == "before":
        await system.checkpoint(ref)
    ref.tell(Add())
    if turn == "waits":
        ref.tell(Go())
        while await ref.ask(Seen()) != ("One", 3):
            await asyncio.sleep(0.01)
    if snapshot == "within":  # A turn that waits lets no other snapshot in.
        await system.replace_state(ref, lambda state: state)
    if kind != "unfit":
        await changed(system, ref, kind)
    if snapshot == "after":
        await system.checkpoint(ref)


async def first(system, end) -> None:
    given = system.ref("/app/given", hf.Actor)
    refs = {}
    for row in ROWS:
        name = "-".join(row)
        if row[0] == "template":
            refs[row] = await given.ask(hf.StartChild(id=name))
        else:
            refs[row] = system.ref(f"/app/moves/{name}" if row[0] == "move" else f"/app/{name}", One)
    await given.ask(hf.supervision.ChangeSupervisor(children=[template(Two)]))
    for row, ref in refs.items():
        await lived(system, ref, *row)
    if end == "killed":
        await system._homes.settled()
        os.kill(os.getpid(), signal.SIGKILL)


async def main(store, what) -> None:
    async with hf.ActorSystem("app", store=f"sqlite:{store}", log=False) as system:
        found = {}
        for one in tree():
            try:
                await system.start(one)
            except hf.StartFailed as error:
                found[f"/app/{one.id}"] = error.reason
        if what != "again":
            await first(system, what)
            return
        for path in system.tree():
            if path.count("-") == 2:
                found[path] = await system.ref(path, One).ask(Seen())
        print(json.dumps(found))
"""
RUN = "import asyncio, sys, changed; asyncio.run(changed.main(*sys.argv[1:]))"


STEPS = {"One": 1, "Two": 100}


def run(folder: Path, what: str, **more: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", RUN, str(folder / "app.db"), what],
        stdout=subprocess.PIPE,
        text=True,
        cwd=folder,
        env=environment(folder, **more),
        timeout=60.0,
    )


@pytest.mark.parametrize(
    ("end", "changes"),
    [("killed", "code template state isolation move protect bind unfit"), ("stopped", "code template")],
)
def test_start_check_and_replay_agree(tmp_path: Path, end: str, changes: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Turns before a class or a state was put in place are no matter of what follows: nobody handles them again."""
    (tmp_path / "changed.py").write_text(CHANGED)
    assert run(tmp_path, end, CHANGES=changes).returncode == (-signal.SIGKILL if end == "killed" else 0)
    store = tmp_path / "app.db"
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("CHANGES", changes)
    monkeypatch.setenv("AGAIN", "yes")
    monkeypatch.delitem(sys.modules, "changed", raising=False)
    checks = {one.address: one for one in check_upgrade(store, "changed:tree").addresses if one.address != "/app/other"}
    before = replay_actor(store, "/app/code-rests-before", until=2)
    assert (before.kept_from, before.state) == (1, {"count": 2}), "by the class of then"
    replays: dict[str, ReplayedState | str] = {}
    for address in checks:
        try:
            replays[address] = replay_actor(store, address, target="changed:tree")
        except StartFailed as error:
            replays[address] = error.reason
    monkeypatch.delitem(sys.modules, "changed")

    started = json.loads(run(tmp_path, "again", CHANGES=changes, AGAIN="yes").stdout)

    assert started.keys() == checks.keys()
    for address, found in started.items():
        check, replayed = checks[address], replays[address]
        if isinstance(found, str):
            assert "unfit" in address
            assert (check.verdict, check.problem, replayed) == ("refused", found, found)
            continue
        kind, count = found
        assert kind == ("Two" if "code" in address or "template" in address else "One")
        assert (check.verdict, check.problem) == ("fine", "")
        assert isinstance(replayed, ReplayedState)
        in_hand = STEPS[kind] if "waits" in address else 0
        assert (replayed.state["count"] + in_hand, replayed.problem) == (count, ""), address
