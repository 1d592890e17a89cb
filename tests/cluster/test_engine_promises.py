"""Simulated servers promise what real ones do."""

from __future__ import annotations

import pytest

from holdfast.testing.fleet.broker import SimBroker
from holdfast.testing.fleet.sim_engine import SimEngine
from tests.cluster.engines import PROMISES, Connect


@pytest.mark.asyncio(loop_factories=["virtual"])
@pytest.mark.parametrize("promise", PROMISES, ids=lambda promise: promise.__name__)
async def test_simulated_servers_keep_it(promise) -> None:  # type: ignore[no-untyped-def]  # see PROMISES
    broker = SimBroker()

    async def connect() -> SimEngine:
        return SimEngine(broker)

    made: Connect = connect
    await promise(made)
