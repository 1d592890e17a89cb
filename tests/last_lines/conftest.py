"""What the tests of the last lines share."""

import sys
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

import holdfast as hf
from holdfast.console.endpoint import control_endpoint

# The actors of these tests are imported by other processes: by name, so the root has to be on the path.
ROOT = str(Path(__file__).parents[2])
if ROOT not in sys.path:
    sys.path.append(ROOT)


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    """A running system that logs nothing itself, so that only its history listens to events."""
    async with hf.ActorSystem("app", log=False, intensity=1000) as running:
        yield running


@pytest.fixture
async def path(system: hf.ActorSystem, tmp_path: Path) -> AsyncIterator[Path]:
    """Where its control endpoint is."""
    async with control_endpoint(system, tmp_path / "app.sock") as where:
        yield where
