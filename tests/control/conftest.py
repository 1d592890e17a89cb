"""What the tests of control share: one actor class, started in every way there is."""

from __future__ import annotations

import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf

# The actors of these tests are imported by other processes: by name, so the root has to be on the path.
ROOT = str(Path(__file__).parents[2])
if ROOT not in sys.path:
    sys.path.append(ROOT)

WAYS: dict[str, dict[str, Any]] = {
    "task": {},
    "process": {"isolation": "process"},
    "recorded task": {"recovery": hf.hybrid(interval=3600.0)},
    "recorded process": {"recovery": hf.hybrid(interval=3600.0), "isolation": "process"},
    "in a subtree": {},
    "recorded in a subtree": {"recovery": hf.hybrid(interval=3600.0)},
    "process in a subtree": {"isolation": "process"},
    "recorded process in a subtree": {"recovery": hf.hybrid(interval=3600.0), "isolation": "process"},
}

Starter = Callable[..., Awaitable[hf.ActorRef[Any]]]


@pytest.fixture
async def system() -> AsyncIterator[hf.ActorSystem]:
    """A running system that allows many restarts; it stops when the test ends."""
    async with hf.ActorSystem("app", log=False, intensity=1000) as running:
        yield running


@pytest.fixture(params=list(WAYS))
def way(request: pytest.FixtureRequest) -> str:
    """Where and how the actor lives."""
    return str(request.param)


@pytest.fixture
def start_one(system: hf.ActorSystem, way: str) -> Starter:
    """Start an actor that way; returns its ref when it is up."""

    async def start(recipe: hf.Start[Any], **options: Any) -> hf.ActorRef[Any]:
        spec = hf.child("one", recipe, **{**WAYS[way], **options})
        if "subtree" not in way:
            return await system.start(spec)
        await system.start(hf.supervisor("top", children=[spec], intensity=1000, isolation="process"))
        return system.ref("/app/top/one", recipe.kind)

    return start


@pytest.fixture(params=["plain", "recorded"])
def recovery(request: pytest.FixtureRequest) -> Any:
    """Without recovery, and with it."""
    return hf.hybrid(interval=3600.0) if request.param == "recorded" else None


@pytest.fixture(params=["task", "process"])
def here(request: pytest.FixtureRequest) -> str:
    """Where the actor lives first."""
    return str(request.param)
