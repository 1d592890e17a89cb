"""A mechanism that a package makes known by an entry point is found by its name, and attached by it."""

from __future__ import annotations

import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.ftm.model.mechanism import ENTRY_POINTS, MechanismRefused, find
from tests.ftm.accounts import Add, Counter, Tags

MODULE = "mechanisms_of_somebody"


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package as pip would have installed it: a module, and what it says of itself."""
    about = tmp_path / f"{MODULE}-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {MODULE}\nVersion: 1.0\n")
    points = {"noting": "Noting", "nobody": "Nobody", "number": "NUMBER"}
    lines = [f"{name} = {MODULE}:{attribute}" for name, attribute in points.items()]
    (about / "entry_points.txt").write_text("\n".join([f"[{ENTRY_POINTS}]", *lines, ""]))
    source = Path(__file__).with_name("masked_sum.py").read_text("utf-8")
    (tmp_path / f"{MODULE}.py").write_text(f"{source}\nNUMBER = 3\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, MODULE, raising=False)
    return tmp_path


@pytest.fixture
async def system(package: Path) -> AsyncIterator[hf.ActorSystem]:
    """One that was started with the package on its path: its processes find it there too."""
    async with hf.ActorSystem("app", log=False) as running:
        yield running


def test_it_is_found_by_its_name_or_said_why_not(package: Path) -> None:
    kind = find("noting")
    assert (kind.__module__, kind.__name__, kind.name) == (MODULE, "Noting", "noting")
    with pytest.raises(MechanismRefused, match=f"its entry point {MODULE}:Nobody cannot be loaded"):
        find("nobody")
    with pytest.raises(MechanismRefused, match=f"its entry point {MODULE}:NUMBER is no Mechanism"):
        find("number")
    with pytest.raises(MechanismRefused, match="no mechanism of that name"):
        find("nothing")


@pytest.mark.asyncio(loop_factories=["uvloop"])  # Processes do not care which event loop the root has.
async def test_it_is_attached_by_its_name(system: hf.ActorSystem) -> None:
    ref = await system.start(hf.child("alice", hf.start(Counter)))
    assert await ref.ask(Add(0)) == 1
    async with system.transaction(timeout=30) as change:
        change.protect(ref, ("noting", "pbr"))
        change.protect(ref, ("noting", "pbr", "tr"))
    layers: Any = ref._cell.spec.mechanism
    assert [layer.name for layer in layers] == ["noting", "pbr", "tr"]
    assert await ref.ask(Add(1)) == 2
    assert await ref.ask(Tags()) == [0, 1]
