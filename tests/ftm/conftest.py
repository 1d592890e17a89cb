"""What the tests of fault-tolerance mechanisms share."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import AsyncIterator, Callable, Mapping
from pathlib import Path

import pytest
import uvloop

import holdfast as hf
from holdfast.ftm.sec.authority import CertificationAuthority

# The actors of these tests are imported by other processes: by name, so the root has to be on the path.
ROOT = str(Path(__file__).parents[2])
if ROOT not in sys.path:
    sys.path.append(ROOT)


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    """A running system that allows many restarts; it stops when the test ends."""
    async with hf.ActorSystem("app", log=False, intensity=1000) as running:
        yield running


@pytest.fixture
async def secured(system: hf.ActorSystem) -> hf.ActorSystem:
    """A system with a certification authority."""
    await system.start(hf.child("ca", hf.start(CertificationAuthority)))
    return system


# These start real processes; what they are about does not depend on the root's loop, and once takes long enough.
ON_ONE_LOOP = {
    "test_ad", "test_attach", "test_author_bricks", "test_background_order", "test_campaign", "test_composed",
    "test_detach_undone", "test_drawn_values", "test_failover",
    "test_failover_turns", "test_images", "test_unhandled_asks",
    "test_in_processes", "test_lfr", "test_lfr_differences", "test_nvp", "test_pbr", "test_pbr_joining", "test_post",
    "test_rb", "test_sec",
    "test_sec_orders", "test_strays", "test_stuck", "test_subtree", "test_subtree_changes", "test_subtree_handing",
    "test_tmr", "test_tmr_failover", "test_tr",
}  # fmt: skip


@pytest.hookimpl(tryfirst=True)
def pytest_asyncio_loop_factories(
    config: pytest.Config, item: pytest.Item
) -> Mapping[str, Callable[[], asyncio.AbstractEventLoop]] | None:
    """One loop for those; None: as everywhere."""
    return {"uvloop": uvloop.new_event_loop} if item.path.stem in ON_ONE_LOOP else None
