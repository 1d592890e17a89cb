"""Simulated servers promise what real ones do, and so do those that are handed encrypted records."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

import pytest

from holdfast.cluster.ports import Engine
from holdfast.cluster.sealed_engine import sealed
from holdfast.testing.fleet.broker import SimBroker
from holdfast.testing.fleet.sim_engine import SimEngine
from tests.cluster.engines import PROMISES, Connect


@pytest.mark.asyncio(loop_factories=["virtual"])
@pytest.mark.parametrize("promise", PROMISES, ids=lambda promise: promise.__name__)
async def test_simulated_servers_keep_it(promise: Callable[[Connect], Awaitable[None]]) -> None:
    broker = SimBroker()

    async def connect() -> Engine:
        return SimEngine(broker)

    await promise(connect)


@pytest.mark.asyncio(loop_factories=["virtual"])
@pytest.mark.parametrize("promise", PROMISES, ids=lambda promise: promise.__name__)
async def test_an_engine_that_encrypts_keeps_it(promise: Callable[[Connect], Awaitable[None]]) -> None:
    broker = SimBroker()

    async def connect() -> Engine:
        return await sealed(SimEngine(broker), bytes(32), "app")

    await promise(connect)
