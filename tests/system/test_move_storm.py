"""Moves, mechanisms and strikes all at once: all of it ends, and nothing that was acknowledged is lost or doubled.

HOLDFAST_SEED repeats one seed; HOLDFAST_STORMS=N has N seeds.
"""

import os

import pytest

from tests.system.move_storm import Storm

SEEDS = (
    [int(os.environ["HOLDFAST_SEED"])]
    if "HOLDFAST_SEED" in os.environ
    else [*range(1, int(os.environ.get("HOLDFAST_STORMS", "3")) + 1)]
)


@pytest.mark.parametrize("seed", SEEDS)
async def test_whatever_is_done_at_once_ends_and_costs_nothing_that_was_acknowledged(seed: int) -> None:
    storm = Storm(seed, steps=30)
    found = await storm.run()
    assert not found, "\n".join([f"seed {seed}", *found, *storm.log])
