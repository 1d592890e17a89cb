"""Mechanisms come, change and go every 200 ms under full load, while replicas are killed (A76-A82).

`HOLDFAST_SOAK=60` soaks for a minute.
"""

from __future__ import annotations

import os
import random

import pytest

from tests.ftm import soak

SECONDS = float(os.environ.get("HOLDFAST_SOAK", "2"))
SEED = os.environ.get("HOLDFAST_SEED", "20261121")


@pytest.mark.asyncio(loop_factories=["uvloop"])
async def test_changes_and_kills_lose_and_double_nothing() -> None:
    pytest.importorskip("cryptography")
    found = await soak.run(SECONDS, random.Random(SEED), least=3)
    assert found.done.total() > 2, found
    assert not found.bad.all(), found
    assert not found.stuck, found
