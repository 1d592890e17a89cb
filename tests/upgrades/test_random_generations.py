"""Random changes of message classes over generations of one program: what comes back is what plain dicts say."""

from __future__ import annotations

import asyncio
import os
import random
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from tests.upgrades import schemas
from tests.upgrades.generations import LONG, Generations

SEEDS = range(int(os.environ.get("HOLDFAST_UPGRADES", "8")))


@pytest.mark.parametrize("seed", SEEDS)
async def test_each_generation_reads_all_before_it(tmp_path: Path, seed: int) -> None:
    print(f"seed {seed}")
    chance, store = random.Random(seed), Generations(tmp_path)
    schema = schemas.first(chance)
    method = chance.choice((hf.hybrid, hf.replay_only))
    said: list[dict[str, Any]] = []  # in the form that the present generation has
    frozen: list[dict[str, Any]] = []  # what a snapshot has, in the form of its generation
    for _ in range(chance.randrange(3, 6)):
        async with store.run(schema.text(), method=method) as (system, actor, module):
            assert await actor.ask(module.Get(), timeout=LONG) == frozen + said, schema
            if method is hf.hybrid:  # It takes a snapshot of its own behind a replay.
                await system.checkpoint(actor, timeout=LONG)
                frozen, said = frozen + said, []
            for _ in range(chance.randrange(4)):
                value = schema.value(chance)
                message = made(module, value)
                reply = await actor.ask(message, timeout=LONG)
                assert reply == message
                said.append(value)
            if method is hf.hybrid and chance.random() < 0.3:
                await system.checkpoint(actor, timeout=LONG)
                frozen, said = frozen + said, []
            if chance.random() < 0.7:  # Some wait when the program ends.
                await system.suspend(actor)
                for _ in range(chance.randrange(3)):
                    said.append(schema.value(chance))
                    actor.tell(made(module, said[-1]))
                await asyncio.sleep(0)
        for _ in range(chance.randrange(3)):
            schema.step(chance, said)


def made(module: Any, value: dict[str, Any]) -> Any:
    """A message with these values: dicts of its fields are the structs in it."""

    def inner(one: Any) -> Any:
        if isinstance(one, dict) and set(one) == {*module.Inner.__struct_fields__}:
            return module.Inner(**one)
        if isinstance(one, dict):
            return {key: inner(item) for key, item in one.items()}
        return [inner(item) for item in one] if isinstance(one, list) else one

    return module.Add(**{name: inner(one) for name, one in value.items()})
