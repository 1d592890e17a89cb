"""What the tests of fault-tolerance mechanisms share."""

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


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    """A running system that allows many restarts; it stops when the test ends."""
    async with hf.ActorSystem("app", log=False, intensity=1000) as running:
        yield running
