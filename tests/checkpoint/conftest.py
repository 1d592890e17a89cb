"""What the tests of recovery share."""

from __future__ import annotations

import sys
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

import holdfast as hf

# The actors of these tests are imported by other processes: by name, so the root has to be on the path.
ROOT = str(Path(__file__).parents[2])
if ROOT not in sys.path:
    sys.path.append(ROOT)


@pytest.fixture(params=["task", "process", "subtree"])
def isolation(request: pytest.FixtureRequest) -> str:
    """The same class, unchanged, lives as a task, in a process of its own, and below a supervisor that has one."""
    return str(request.param)


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    """A running system that allows many restarts; it stops when the test ends."""
    async with hf.ActorSystem("app", log=False, intensity=1000) as running:
        yield running


@pytest.fixture
def gate(tmp_path: Path) -> Path:
    """Where a `Doer` stops, until it is let through."""
    return tmp_path / "gate"


@pytest.fixture(params=["memory", "sqlite"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> str | None:
    """Where journals go: nowhere beyond this process, or into a file."""
    return None if request.param == "memory" else f"sqlite:{tmp_path / 'app.db'}"
