"""What tests of actors share: a system of their own."""

import sys
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

import holdfast as hf

# The actors of some tests are imported by other processes: by name, so the root has to be on the path.
ROOT = str(Path(__file__).parents[2])
if ROOT not in sys.path:
    sys.path.append(ROOT)


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    """A running system; it stops when the test ends."""
    async with hf.ActorSystem("t", log=False, seed=1) as running:
        yield running
