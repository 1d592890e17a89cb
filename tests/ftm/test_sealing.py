"""States that cannot be saved: the turn that has left one fails, and nothing else does."""

from __future__ import annotations

import pytest

import holdfast as hf
from holdfast.actors.errors import UnsavableValue
from tests.ftm.replicated import Add, Read, Spoil, pair


@pytest.mark.parametrize("together", [False, True])
async def test_a_turn_that_leaves_an_unsavable_state_fails(system: hf.ActorSystem, together: bool) -> None:
    """Only that turn, with the error for who has asked; neither the replica nor its successor dies of it."""
    driver = await pair(system)
    if together:
        keys = driver.send(Add(1), Spoil(2), Add(3), Spoil(4), Add(5))
    else:
        keys = [driver.send(one)[0] for one in (Add(1), Spoil(2), Add(3), Spoil(4), Add(5))]
    assert [await driver.reply(keys[at]) for at in (0, 2, 4)] == [1, 4, 9]
    for at in (1, 3):
        with pytest.raises(UnsavableValue, match="spoilt"):
            await driver.reply(keys[at])
    assert [driver.ends[key].turn for key in keys] == [1, 2, 3, 4, 5]
    await driver.stop_replica("r1")
    await driver.fail_over("r2")
    assert await driver.ask(Read()) == [1, 3, 5]
