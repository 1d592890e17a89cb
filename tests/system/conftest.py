"""What the tests of systems share."""

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
    """A running system with the tree of `trees.py`."""
    from tests.system.trees import plant

    async with hf.ActorSystem("app", log=False, intensity=1000) as running:
        await plant(running)
        yield running
