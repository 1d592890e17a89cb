"""`holdfast run`: a system from specs, from a file, or with an async main; told to a service manager, and reloaded."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import inspect
import os
import signal
import sys
from collections.abc import AsyncGenerator, Awaitable, Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from ...actors.errors import HoldfastError, SpecError
from ...actors.kernel.actor import Start
from ...checkpoint.method import Durability
from ...system.run import run as run_loop
from ...system.system import ActorSystem
from ...system.transaction.change import Change
from ...system.transaction.living import ReplaceActorCode
from ...system.upgrade.new_program import find_in, load_named, specs_in
from ..declare.tree_plan import actor_places, change_to, declare, other_code
from ..declare.wanted_tree import WantedSpecs
from ..endpoint import served
from ..operate.reaching import FAILED, UNUSABLE, ended
from .health import Service
from .notify import Notifier
from .reloading import ProjectModules
from .store_options import KeyFile

RELOAD_TIMEOUT = 60.0
"""Seconds that a reload may take."""
MAIN_TIMEOUT = 5.0
"""Seconds that a main may take to end when it is cancelled."""


@dataclasses.dataclass(frozen=True, slots=True)
class ServedProgram:
    """What is run: a file, or what a module names."""

    target: str
    main: Callable[[ActorSystem], Awaitable[Any]] | None = None

    @property
    def is_file(self) -> bool:
        """Whether it is a tree in a file."""
        return self.target.endswith(".toml")

    async def begin(self, system: ActorSystem) -> None:
        """Start all that is not started by a main."""
        if self.is_file:
            await declare(system, _text(self.target), self.target, timeout=RELOAD_TIMEOUT)
        elif self.main is None:
            for path, spec in specs_in(self.target, load_named(self.target)).items():
                if path.count("/") == 1:  # The others are started while it runs.
                    await system.start(spec)

    async def reload(self, system: ActorSystem, modules: ProjectModules | None) -> list[str]:
        """Have the running system be as the file, or the modules, say now; returns the steps in words.

        Raises:
            HoldfastError: it cannot; all is as before.
        """
        if modules is None:
            text = _text(self.target)
            return _words(await declare(system, text, self.target, keep_all=True, timeout=RELOAD_TIMEOUT))
        with modules.imported_again() as names:
            if self.main is not None:
                return await _replace_codes(system, names)
            specs = specs_in(self.target, load_named(self.target))
            top = [spec for path, spec in specs.items() if path.count("/") == 1]
            wanted = WantedSpecs(system.name, top, self.target)
            return _words(await change_to(system, wanted, keep_all=True, timeout=RELOAD_TIMEOUT))


def load_program(target: str) -> ServedProgram:
    """Find what is to be run. Raises SpecError: there is no such thing."""
    if target.endswith(".toml"):
        _text(target)
        find_in(os.getcwd())
        return ServedProgram(target)
    if target.partition(":")[0].endswith(".py"):
        raise SpecError(target, "name a module, such as shop.tree:tree: actors in processes are imported by its name")
    found = load_named(target)
    if not inspect.iscoroutinefunction(found):
        specs_in(target, found)
        return ServedProgram(target)
    if len(inspect.signature(found).parameters) != 1:
        raise SpecError(target, "an async main takes the running system: async def main(system)")
    return ServedProgram(target, found)


def _text(file: str) -> str:
    try:
        return Path(file).read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SpecError(file, str(error)) from error


def _words(change: Change | None) -> list[str]:
    return [] if change is None else [step.text for step in change.steps]


async def _replace_codes(system: ActorSystem, names: set[str]) -> list[str]:
    """Have all actors whose classes are in these modules go on as the new ones."""
    steps: list[ReplaceActorCode] = []
    for place in actor_places(system):
        kind = place.kind
        if kind is None or kind.__module__ not in names:
            continue
        new = vars(sys.modules[kind.__module__]).get(kind.__qualname__)
        if new is None:
            raise SpecError(place.path, f"{kind.__module__} has no {kind.__qualname__} any more")
        known = place.spec.start if place.spec is not None else Start(kind)
        steps.append(other_code(place, Start(new, known.args, known.kwargs), place.path))
    if not steps:
        return []
    async with system.transaction(timeout=RELOAD_TIMEOUT) as change:
        for step in steps:
            change.step(step)
    return _words(change)


async def serve(program: ServedProgram, system: ActorSystem, probes: str | None) -> None:
    """Run the program until it is told to stop, or its main has returned; probes are answered at `probes`, if given."""
    service = Service(system, probes=probes)
    async with served(system, entered=service) as socket:
        await program.begin(system)
        modules = None if program.is_file else ProjectModules(program.target.partition(":")[0])
        async with _reloads() as asked:
            main: asyncio.Future[Any] | None = None
            if program.main is not None:
                main = asyncio.ensure_future(program.main(system))
            service.up()
            tell(f"{system.name} runs, control endpoint {socket}")
            try:
                while main is None or not main.done():
                    waiting = asyncio.create_task(asked.get())
                    await asyncio.wait({waiting, *([main] if main is not None else [])}, return_when="FIRST_COMPLETED")
                    if not waiting.cancel():
                        await _reload(program, system, modules, service.notifier)
                if main is not None:
                    main.result()
            finally:
                service.stopping()  # Now: the main may take a while to end.
                if main is not None and not main.done():
                    main.cancel()
                    if not (await asyncio.wait({main}, timeout=MAIN_TIMEOUT))[0]:
                        left = "the system stops, and SIGTERM ends the rest"
                        tell(f"its main has not ended within {MAIN_TIMEOUT:g} s: {left}")


def tell(text: str) -> None:
    """A line for whoever looks after the program, on standard error."""
    typer.echo(f"holdfast run: {text}", err=True)


async def _reload(
    program: ServedProgram, system: ActorSystem, modules: ProjectModules | None, notifier: Notifier
) -> None:
    """Reload, and say what has become of it: whoever has sent the signal reads it in the log."""
    notifier.reloading()
    try:
        steps = await program.reload(system, modules)
    except HoldfastError as error:
        tell(f"reload failed, all is as before: {error}")
        notifier.ready(f"reload failed: {error}")
    else:
        tell(f"reloaded: {'; '.join(steps) or 'nothing to do'}")
        notifier.ready(f"{system.name} runs")


@contextlib.asynccontextmanager
async def _reloads() -> AsyncGenerator[asyncio.Queue[None], None]:
    """While the block runs, each SIGHUP is put into a queue; one that waits stands for all that come meanwhile."""
    loop = asyncio.get_running_loop()
    asked: asyncio.Queue[None] = asyncio.Queue(1)

    def ask() -> None:
        if asked.empty():
            asked.put_nowait(None)

    loop.add_signal_handler(signal.SIGHUP, ask)
    try:
        yield asked
    finally:
        loop.remove_signal_handler(signal.SIGHUP)


def run(
    target: Annotated[
        str,
        typer.Argument(
            metavar="TARGET",
            help="module:name of specs, of a function of them, or of an async def main(system); or TREE.toml.",
        ),
    ],
    name: Annotated[
        str, typer.Option("--name", help="The name of the system, the first part of all addresses.")
    ] = "app",
    store: Annotated[str | None, typer.Option(help="Where states are kept: sqlite:app.db.")] = None,
    durability: Annotated[str | None, typer.Option(help="memory, os or fsync.")] = None,
    recovery: Annotated[Path | None, typer.Option(metavar="FILE", help="A recovery file.")] = None,
    key_file: KeyFile = None,
    takeover: Annotated[bool, typer.Option("--takeover", help="Kill the process that has the store open.")] = False,
    probes: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Where /livez and /readyz are answered over HTTP.")
    ] = None,
) -> None:
    """Run a system until it is told to stop: its control endpoint is open, and the service manager is told how it is.

    SIGTERM and SIGINT stop it in order. SIGHUP reloads it: the file is read again, or modules that have changed are
    imported again, and what runs is changed to that by one transaction, with state kept; or nothing is.

    Exit status 0: its main has returned. 143: SIGTERM. 1: it has failed, or could not start. 2: no such target.
    """
    try:
        program = load_program(target)
    except HoldfastError as error:
        raise ended("run", error, UNUSABLE) from error

    try:
        chosen: Durability | None = durability  # type: ignore[assignment]  # it is looked at where it is used
        system = ActorSystem(
            name, store=store, store_key=key_file, durability=chosen, recovery=recovery, takeover=takeover
        )
        run_loop(serve(program, system, probes))
    except HoldfastError as error:
        raise ended("run", error, FAILED) from error
    except KeyboardInterrupt:
        raise typer.Exit(130) from None
