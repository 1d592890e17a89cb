"""A running system with its control endpoint, for the tests of the command line."""

import sys
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

import holdfast as hf
from holdfast.console.endpoint import control_endpoint
from tests.system.trees import plant

# What a command sends is rebuilt by name in the system that it reaches, so the root has to be on the path.
ROOT = str(Path(__file__).parents[2])
if ROOT not in sys.path:
    sys.path.append(ROOT)


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    """A running system with the tree of the tests of transactions."""
    async with hf.ActorSystem("app", log=False, intensity=1000) as running:
        await plant(running)
        yield running


@pytest.fixture
async def path(system: hf.ActorSystem, tmp_path: Path) -> AsyncIterator[Path]:
    """Where its control endpoint is."""
    async with control_endpoint(system, tmp_path / "app.sock") as where:
        yield where
