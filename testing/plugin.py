"""The pytest plugin: fixtures for tests of actors. It works on pytest-asyncio, 1.4 or later.

`actor_system` and `actor_systems` give isolated running systems that fail the test for what it leaves behind or did not
expect; `probe` is a probe in `actor_system`. Everything heavy is imported inside the fixtures: pytest loads plugins
before coverage begins to measure.
"""

from __future__ import annotations

import asyncio
import importlib
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from typing import TYPE_CHECKING, Any, TypeVar, cast

import pytest

if TYPE_CHECKING:
    from .guarded import Guard, GuardedSystem
    from .probes import Probe

    ActorSystems = Callable[..., Awaitable[GuardedSystem]]

Function = TypeVar("Function", bound=Callable[..., Any])


def async_fixture(function: Function) -> Function:
    """A fixture by pytest-asyncio. The plugin is loaded wherever holdfast is installed; only its fixtures need that."""
    try:
        made = importlib.import_module("pytest_asyncio").fixture
    except ImportError:
        made = _missing
    return cast("Function", made(function))


def _missing(function: Callable[..., Any]) -> Any:
    """In place of an async fixture, where there is no pytest-asyncio."""

    @pytest.fixture(name=function.__name__)
    def missing() -> None:
        pytest.fail("the fixtures of holdfast need pytest-asyncio: pip install 'holdfast[testing]'", pytrace=False)

    return missing


LOOPS = ("uvloop", "asyncio")
EXPECTABLE = ("dead_letters", "crashes", "leaks", "sends")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addini(
        "holdfast_loops",
        f"event loops that each async test runs under: of {', '.join(LOOPS)}; a test gets the virtual clock by "
        '@pytest.mark.asyncio(loop_factories=["virtual"])',
        type="args",
        default=[],
    )
    parser.addini(
        "holdfast_expect",
        f"what no test shall fail for: of {', '.join(EXPECTABLE)}",
        type="args",
        default=[],
    )


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line(
        "markers",
        "holdfast(dead_letters=, crashes=, leaks=, sends=, **options): what this test of actors expects (True), or how "
        "often (a number); other options go to ActorSystem",
    )
    _choose("holdfast_expect", config.getini("holdfast_expect"), EXPECTABLE)
    loops: list[str] = config.getini("holdfast_loops")
    _choose("holdfast_loops", loops, LOOPS)
    # Only then: with a hook for loops, pytest-asyncio puts the loop's name into the id of every async test.
    if loops and config.pluginmanager.has_plugin("asyncio"):
        config.pluginmanager.register(LoopFactories(loops), "holdfast loops")


def _choose(option: str, chosen: list[str], known: tuple[str, ...]) -> None:
    unknown = [name for name in chosen if name not in known]
    if unknown:
        raise pytest.UsageError(f"{option}: {unknown[0]!r} is none of {', '.join(known)}")


class LoopFactories:
    """Tells pytest-asyncio which loops there are."""

    def __init__(self, names: list[str]) -> None:
        self._names = names

    def pytest_asyncio_loop_factories(
        self, config: pytest.Config, item: pytest.Item
    ) -> Mapping[str, Callable[[], asyncio.AbstractEventLoop]]:
        marker = item.get_closest_marker("asyncio")
        asked = marker.kwargs.get("loop_factories", ()) if marker is not None else ()
        # The virtual clock by name only: other tests run under the real loops.
        return {name: _loop_factory(name) for name in (*self._names, *(["virtual"] if "virtual" in asked else []))}


def _loop_factory(name: str) -> Callable[[], asyncio.AbstractEventLoop]:
    if name == "virtual":
        from .clock import virtual

        return virtual
    if name == "uvloop":
        import uvloop

        return uvloop.new_event_loop
    return asyncio.new_event_loop


class Wanted:
    """What a test's markers and the configuration say."""

    def __init__(self, request: pytest.FixtureRequest) -> None:
        expected: dict[str, Any] = dict.fromkeys(request.config.getini("holdfast_expect"), True)
        options: dict[str, Any] = {}
        for marker in reversed(list(request.node.iter_markers("holdfast"))):  # The closest one has the last word.
            for name, value in marker.kwargs.items():
                (expected if name in EXPECTABLE else options)[name] = value
        self.options = options
        self.leaks = bool(expected.get("leaks"))
        self._expected = expected

    def tell(self, system: GuardedSystem) -> None:
        """Let a system know what it may see."""
        for name, expect in (("dead_letters", system.expect_dead_letters), ("crashes", system.expect_crashes)):
            value = self._expected.get(name, False)
            if value is True:
                expect(None)
            elif value:
                expect(int(value))
        if self._expected.get("sends"):
            system.expect_sends()


@async_fixture
async def actor_guard(request: pytest.FixtureRequest) -> AsyncIterator[Guard]:
    """The systems of one test, and the look at what they leave."""
    from .guarded import Guard

    guard = Guard(leaks=not Wanted(request).leaks)
    yield guard
    await guard.close()


@pytest.fixture
def actor_systems(actor_guard: Guard, request: pytest.FixtureRequest) -> ActorSystems:
    """Start a system: `system = await actor_systems("name", store=...)`, as often as the test likes."""
    from .guarded import GuardedSystem

    wanted = Wanted(request)

    async def start(name: str = "app", **options: Any) -> GuardedSystem:
        system = await actor_guard.start(GuardedSystem(name, **{**wanted.options, **options}))
        wanted.tell(system)
        return system

    return start


@async_fixture
async def actor_system(actor_systems: ActorSystems) -> GuardedSystem:
    """A running system of the test's own, on the test's loop; it ends with the test."""
    return await actor_systems()


@pytest.fixture
def probe(actor_system: GuardedSystem) -> Probe:
    """A probe in `actor_system`."""
    from .probes import probe

    return probe(actor_system)
