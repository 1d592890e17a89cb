"""The pytest plugin: fixtures for tests of actors. It works on pytest-asyncio, 1.4 or later.

`actor_system` and `actor_systems` give isolated running systems that fail the test for what it leaves behind or did not
expect; `probe` is a probe in `actor_system`, and `sim_fleet` a simulated fleet. Everything heavy is imported inside the
fixtures: pytest loads plugins before coverage begins to measure.
"""

from __future__ import annotations

import argparse
import asyncio
import importlib
import types
from collections.abc import AsyncIterator, Awaitable, Callable, Generator, Mapping
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from .fleet.sim_fleet import SimFleet
    from .guarded import Guard, GuardedSystem
    from .probes import Probe
    from .wanted import SystemsWanted

    ActorSystems = Callable[..., Awaitable[GuardedSystem]]


LOOP_SCOPES = ("function", "class", "module", "package", "session")
Makers = dict[str, Callable[..., Any]]
"""What makes a fixture, by the scope of the loop in which it does so."""


def async_fixture(function: Callable[..., Any], *, name: str) -> tuple[Any, Makers]:
    """A fixture by pytest-asyncio, which makes it in the loop of a function, and what makes it in other loops.

    The plugin is loaded wherever holdfast is installed; only its fixtures need pytest-asyncio.
    """
    try:
        fixture = importlib.import_module("pytest_asyncio").fixture
    except ImportError:
        return pytest.fixture(_missing, name=name), {}
    made: dict[str, Any] = {}
    for scope in LOOP_SCOPES:  # Each a function of its own: pytest-asyncio keeps the scope at the function.
        own = types.FunctionType(function.__code__, function.__globals__, name, (None,), function.__closure__)
        made[scope] = own, fixture(own, name=name, loop_scope=scope)
    return made["function"][1], {scope: own for scope, (own, _) in made.items()}


def _missing() -> None:
    """In place of an async fixture, where there is no pytest-asyncio."""
    pytest.fail("the fixtures of holdfast need pytest-asyncio: pip install 'holdfast[testing]'", pytrace=False)


EXPECTABLE = ("dead_letters", "crashes", "leaks", "sends", "replies", "types", "exceptions")
LOOPS = ("uvloop", "asyncio")
PROFILES = ("ci", "nightly")


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

    group = parser.getgroup("holdfast", "simulated tests of actors (@simulate)")
    group.addoption("--holdfast-seed", type=int, default=None, help="run only this seed")
    group.addoption("--holdfast-seeds", type=_count, default=None, help="run so many seeds, whatever a test says")
    group.addoption("--holdfast-replay", metavar="FILE", default=None, help="run only the schedule in this file")
    group.addoption(
        "--holdfast-record",
        metavar="FOLDER",
        default=None,
        help="keep of each failing test its seed, schedule, time line and text there, as an artefact of CI",
    )
    group.addoption(
        "--holdfast-real",
        action="store_true",
        default=None,
        help="run simulated tests on a real loop, in real time, with real processes",
    )
    group.addoption(
        "--holdfast-profile",
        choices=PROFILES,
        default="ci",
        help="ci: as many seeds as a test says; nightly: 25 times as many, and each run is made twice",
    )
    group.addoption(
        "--holdfast-twice",
        metavar="N",
        type=_count,
        default=None,
        help="make every Nth run of a simulated test twice, to see whether its seed repeats it (10; nightly: 1)",
    )


def _count(text: str) -> int:
    """How many: at least one, or the tests would pass without having run."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no number: it takes one or more")
    return int(text)


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line(
        "markers",
        "holdfast(dead_letters=, crashes=, leaks=, sends=, replies=, types=, exceptions=, **options): what this test "
        "of actors expects (True), or how often (a number); other options go to ActorSystem",
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


WANTED = pytest.StashKey["SystemsWanted"]()


def _wanted(item: pytest.Item) -> SystemsWanted:
    """What the test expects, which is read once."""
    found = item.stash.get(WANTED, None)
    if found is None:
        from .wanted import SystemsWanted

        found = item.stash[WANTED] = SystemsWanted(item, EXPECTABLE)
    return found


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> Generator[None, Any, Any]:
    """Let `@simulate` know what the test expects."""
    from .wanted import running

    token = running.set(_wanted(pyfuncitem))
    try:
        return (yield)
    finally:
        running.reset(token)


GUARD = pytest.StashKey["Guard"]()
GUARDS = pytest.StashKey["type[Guard]"]()


class GuardOf:
    """The guard of a test, which looks at what is left when the fixture ends that was the first to ask for it."""

    def __init__(self, item: pytest.Item) -> None:
        self._item = item
        self._own: Guard | None = None

    async def __aenter__(self) -> Guard:
        found = self._item.stash.get(GUARD, None)
        if found is not None:
            return found
        wanted = _wanted(self._item)
        guard = _guards(self._item.config)(allowed=wanted.leaks, exceptions=not wanted.exceptions)
        self._own = self._item.stash[GUARD] = guard
        return guard

    async def __aexit__(self, *error: object) -> None:
        if self._own is not None:
            del self._item.stash[GUARD]
            await self._own.close()


def _guards(config: pytest.Config) -> type[Guard]:
    """The class of guards, imported once: an `import` within a function takes longer than most calls."""
    found = config.stash.get(GUARDS, None)
    if found is None:
        from .guard.sends import stay_ready
        from .guarded import Guard

        found = config.stash[GUARDS] = Guard
        config.add_cleanup(stay_ready())
    return found


async def system_of_the_test(item: pytest.Item | None = None) -> AsyncIterator[GuardedSystem]:
    """A running system of the test's own, on the test's loop; it ends with the test."""
    assert item is not None, "the test is given by `pytest_fixture_setup`"
    wanted = _wanted(item)
    async with GuardOf(item) as guard:
        system = await guard.start(**wanted.options)
        wanted.tell(system)
        yield system


async def systems_of_the_test(item: pytest.Item | None = None) -> AsyncIterator[ActorSystems]:
    """Start a system: `system = await actor_systems("name", store=...)`, as often as the test likes."""
    assert item is not None, "the test is given by `pytest_fixture_setup`"
    wanted = _wanted(item)
    async with GuardOf(item) as guard:

        async def start(name: str = "app", **options: Any) -> GuardedSystem:
            system = await guard.start(name, **{**wanted.options, **options})
            wanted.tell(system)
            return system

        yield start


async def fleet_of_the_test(item: pytest.Item | None = None) -> AsyncIterator[SimFleet]:
    """A simulated fleet of the test's own, without faults, whose programs end with the test."""
    from .clock import VirtualClockLoop
    from .fleet.sim_fleet import SimFleet

    if not isinstance(asyncio.get_running_loop(), VirtualClockLoop):
        pytest.fail(
            'sim_fleet needs the virtual clock: @pytest.mark.asyncio(loop_factories=["virtual"])', pytrace=False
        )
    async with SimFleet() as fleet:
        yield fleet


actor_system, _makers = async_fixture(system_of_the_test, name="actor_system")
actor_systems, _more_makers = async_fixture(systems_of_the_test, name="actor_systems")
sim_fleet, _fleet_makers = async_fixture(fleet_of_the_test, name="sim_fleet")
MAKERS = {makers["function"]: makers for makers in (_makers, _more_makers, _fleet_makers) if makers}
"""The same by what pytest knows each fixture by."""


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_fixture_setup(
    fixturedef: pytest.FixtureDef[Any], request: pytest.FixtureRequest
) -> Generator[None, object, object]:
    """Have the systems of a test made in its loop: a fixture of pytest-asyncio has one scope, and so has a test.

    The test is given as a default of the function: to ask pytest for `request` costs as much as half of the guard.
    """
    makers, function = MAKERS.get(fixturedef.func), fixturedef.func
    if makers is None:
        return (yield)
    put: Any = fixturedef  # as pytest-asyncio does, which exchanges the function, too
    try:
        put.func = _of_test(makers[_loop_scope_of(request)], request.node)
    except pytest.fail.Exception as refused:
        put.func = _raising(refused)  # Where the fixture is made: pytest has to see that it was begun.
    try:
        return (yield)
    finally:
        put.func = function


def _raising(error: BaseException) -> Callable[..., None]:
    """In place of a fixture that is refused."""

    def refused(**given: object) -> None:
        raise error

    return refused


def _of_test(maker: Any, item: pytest.Item) -> Any:
    """The same function, whose one parameter is the test by default."""
    own = types.FunctionType(maker.__code__, maker.__globals__, maker.__name__, (item,), maker.__closure__)
    own.__dict__.update(maker.__dict__)  # what pytest-asyncio keeps there
    return own


def _loop_scope_of(request: pytest.FixtureRequest) -> str:
    """The scope of the loop that the test runs in.

    Raises:
        pytest.fail.Exception: the test does not run in a loop of pytest-asyncio.
    """
    closest: dict[str, pytest.Mark] = {}
    for mark in request.node.iter_markers():
        closest.setdefault(mark.name, mark)
    marker, of_anyio = closest.get("asyncio"), closest.get("anyio")
    if of_anyio is not None or "anyio_backend" in request.fixturenames:
        if marker is None or of_anyio is not None:
            why = "runs this test in another one: mark it with @pytest.mark.asyncio instead of @pytest.mark.anyio"
        else:
            why = "takes the async fixtures of all async tests to another one: set anyio_mode = strict"
        pytest.fail(
            f"the fixtures of holdfast run in the loop of pytest-asyncio, and anyio's plugin {why}", pytrace=False
        )
    scope = None
    if marker is not None:
        scope = marker.kwargs.get("loop_scope") or marker.kwargs.get("scope")
    if scope is None and request.config.pluginmanager.has_plugin("asyncio"):
        scope = request.config.getini("asyncio_default_test_loop_scope")
    return scope or "function"


@pytest.fixture
def probe(actor_system: GuardedSystem) -> Probe:
    """A probe in `actor_system`."""
    from .probes import probe

    return probe(actor_system)
