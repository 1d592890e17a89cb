"""A simulated fleet in a test with `@simulate`: one seed decides every step of all its programs.

Which actor or task of which program is next, how long frames between programs take, and which faults strike: all are
choices of the run, which are kept, repeated and shrunk.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from ...system.system import ActorSystem
from ..guarded import GuardedSystem
from ..schedules.choices import Choices
from ..schedules.places import inside
from .sim_fleet import SimFleet, SimProgram

if TYPE_CHECKING:
    from ..schedules.control import ControlledLoop


class GuardedFleet(SimFleet):
    """The fleet of a test with `@simulate`, which gets it as its parameter `fleet`.

    The systems of its programs are guarded: at the end the test hears of crashes and dead letters in any of them that
    it did not expect. A program that is killed ends at that very moment, and so do the processes of its actors.

    Args:
        choices: of the run.
        loop: in which it runs.
        options: for each system, unless its program says otherwise.
        entered: called with each system that has been started.
    """

    def __init__(
        self,
        choices: Choices,
        loop: ControlledLoop,
        options: Mapping[str, Any],
        entered: Callable[[GuardedSystem], None],
    ) -> None:
        super().__init__(choices.seed, choices=choices)
        self._loop, self._options, self._entered = loop, options, entered
        self.expected = GuardedSystem("fleet")
        self.systems: list[GuardedSystem] = [self.expected]

    def expect_crashes(self, count: int | None = None) -> None:
        """Crashes of actors and deaths of their processes are meant to be: exactly `count` more, or any number."""
        self.expected.expect_crashes(count)

    def expect_dead_letters(self, count: int | None = None) -> None:
        """Dead letters are meant to be: exactly `count` more, or any number."""
        self.expected.expect_dead_letters(count)

    def expect_exceptions(self) -> None:
        """Do not complain of exceptions in tasks, futures and callbacks that nobody has seen."""
        self.expected.expect_exceptions()

    def make_system(self, name: str, options: dict[str, Any]) -> ActorSystem:
        number = len(self.systems)  # No two programs draw the same random numbers.
        system = FleetSystem(name, self._entered, {**self._options, "seed": 1000 * self.seed + number, **options})
        system.join(self.expected)
        self.systems.append(system)
        return system

    def end(self, program: SimProgram) -> None:
        """Have nothing of a program run any more, from this step on; what it has sent arrives."""
        program.servers.cut(log=False)
        for system in self.systems:
            if system in program.systems:
                system.was_killed()
        program.halt(self._loop)
        if inside.get() is None:
            program.bury()
        else:  # It is its own step that ends it, which goes to its end, and reaches nobody.
            self.later(0.0, program.bury)


class FleetSystem(GuardedSystem):
    """A system of a program of a simulated fleet.

    Args:
        name: of it.
        entered: called when it has been started.
        options: as `GuardedSystem` takes them.
    """

    def __init__(self, name: str, entered: Callable[[GuardedSystem], None], options: dict[str, Any]) -> None:
        super().__init__(name, **options)
        self._entered = entered

    async def __aenter__(self) -> FleetSystem:
        await super().__aenter__()
        self._entered(self)
        return self
