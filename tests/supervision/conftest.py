"""What the tests of supervision share."""

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
    async with hf.ActorSystem("app", log=False, intensity=1000) as running:
        yield running
