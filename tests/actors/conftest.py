"""What tests of actors share: a system of their own."""

from collections.abc import AsyncIterator

import pytest

import holdfast as hf


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    """A running system; it stops when the test ends."""
    async with hf.ActorSystem("t", log=False, seed=1) as running:
        yield running
