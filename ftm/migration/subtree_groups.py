"""Protected children of a supervisor in another process: their whole group is here, at the root.

The supervisor in the process wants a life; it is lived by replicas, which are processes of the root as always, and the
death of one of them does not concern that supervisor. It hears of the end of the life, and decides what follows. When
its process dies, the group ends with it; the home keeps what it holds until the subtree has been started again.
"""

from __future__ import annotations

import asyncio
import dataclasses
import sys
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import msgspec

from ...actors.errors import HoldfastError, StartFailed, StartIgnored
from ...actors.exit_reasons import ExitReason, pack_exit, unpack_exit
from ...actors.kernel import lifecycle
from ...actors.kernel.actor import Start
from ...actors.kernel.bindings import settle_claims
from ...actors.kernel.cell import RUNNING, Cell
from ...actors.migration.move import Gate
from ...actors.process.wire.start_codec import pack_recipe
from ...checkpoint.protocol import Closed, Over, Respec, Started, Wanted
from ...supervision.respec import recipe_spec
from ..group.group_host import GroupHost
from ..group.reconfiguration import REST_WITHIN, Reconfiguration
from ..group.transient_homes import forget_later, is_unkept
from ..model.composition import check_stack, describe
from ..model.mechanism import COMMON, Code, Description, Mechanism, MechanismRefused, revive

if TYPE_CHECKING:
    from ...checkpoint.home.recorded_hosts import RemoteLife
    from ...checkpoint.home.subtree_homes import SubtreeHome
    from ...checkpoint.method import Method

STOPPED_STARTING = "it was stopped while it started"


class SubtreeGroup(GroupHost):
    """The host of one such child."""

    def __init__(self, place: SubtreeHome, method: Method, layers: tuple[Mechanism, ...]) -> None:
        super().__init__(place.homes, method, layers)
        self.place = place  # where its supervisor is heard
        self._wanted: Wanted | None = None  # the life that is begun or lived
        self._recipe = b""
        self._topics: list[str] = []
        self._port: RemoteLife | None = None  # to the supervisor in the process
        self._last: tuple[int, bool, float] | None = None  # how a life has ended of which that one has not said yet

    # -- what the supervisor says -----------------------------------------------------------------------------------

    def begin(self, cell: Cell, wanted: Wanted, port: RemoteLife) -> None:
        """Begin the life that is wanted; nothing is left of the last one."""
        made = wanted.protected
        assert made is not None
        self._wanted, self._port = wanted, port
        self._recipe, self._topics = made.recipe, wanted.topics
        self._stop_wanted = self._last = None
        spec = recipe_spec(cell)
        settle_claims(cell, {} if spec is None else spec.bindings)
        try:
            entered = self.enter(cell)  # Now: from here on what is sent is admitted by the home.
        except StartFailed as error:  # What is recorded does not fit its class.
            self._wanted = None
            port.to_life(Started(wanted.number, error.reason))
            return
        context = cell.node.base_context.copy()  # Not in that of the socket, which is whoever's had the process.
        self._starting = lifecycle.outside_turn(cell, self._begin(cell, wanted, port, entered), context=context)

    async def _begin(self, cell: Cell, wanted: Wanted, port: RemoteLife, entered: Any) -> None:
        outcome = Started(wanted.number)
        try:
            await self._recover(cell, *entered)
        except asyncio.CancelledError:
            outcome.problem = STOPPED_STARTING
        except HoldfastError as error:
            outcome.problem = error.reason if isinstance(error, StartFailed) else str(error)
            outcome.is_ignored = isinstance(error, StartIgnored)
        if self._wanted is wanted:
            if outcome.problem or outcome.is_ignored:
                self._wanted = None
            port.to_life(outcome)

    @property
    def starting(self) -> asyncio.Future[None] | None:
        """The start that is under way, or the last one; its supervisor hears of its end."""
        return self._starting

    def prepare(self, recipe: bytes, topics: list[str]) -> None:
        """A life is to be handed over, of an actor that begins so."""
        self._recipe, self._topics = recipe, topics

    def found(self, wanted: Wanted, port: RemoteLife) -> None:
        """The life that is lived here already is the one that is wanted."""
        self._wanted, self._port = wanted, port

    @property
    def number(self) -> int:
        """That under which the supervisor wants the present life."""
        return -1 if self._wanted is None else self._wanted.number

    def hand_over(self) -> Wanted:
        """The life is lived in the process again."""
        wanted, self._wanted = self._wanted, None
        assert wanted is not None
        return wanted

    def described(self) -> list[Any]:
        """The mechanisms as data."""
        return [msgspec.to_builtins(layer.describe()) for layer in self.layers]

    def left(self) -> list[asyncio.Task[None]]:
        """What has to come to its end before another life may begin."""
        return [task for task in (self._ending, self._starting) if task is not None and not task.done()]

    def closed(self, record: Closed) -> None:
        """The supervisor has heard of the end of a life, or gives up its start."""
        cell = None if self.switch is None else self.switch.cell
        if self._wanted is None or record.number != self._wanted.number or cell is None:
            return
        self._wanted = None
        self._end_unwanted(cell, unpack_exit(record.reason), recovers=record.recovers)

    def lost(self, cell: Cell, reason: ExitReason) -> None:
        """The supervisor has died with its process: nobody is left who would stop the replicas."""
        if self._wanted is not None:
            self._wanted = None
            self._end_unwanted(cell, reason, recovers=True)

    def _end_unwanted(self, cell: Cell, reason: ExitReason, *, recovers: bool) -> None:
        """Nobody wants the life any more, however far it has come."""
        if self._last is not None:
            self._close(cell, reason, recovers=recovers)
        elif self._starting is not None and not self._starting.done():
            self._starting.cancel()
        else:
            self._begin_end(cell, reason, -1, ordered=True)

    # -- the end of a life ------------------------------------------------------------------------------------------

    def life_over(
        self, cell: Cell, reason: ExitReason, failed: StartFailed | None, running: int, noticed: float, *, ordered: bool
    ) -> None:
        self._last = running, ordered or running < 0, noticed
        wanted, port = self._wanted, self._port
        if wanted is None or failed is not None:
            self._close(cell, reason, recovers=True)
        elif port is not None:
            port.to_life(Over(wanted.number, pack_exit(reason)))

    def _close(self, cell: Cell, reason: ExitReason, *, recovers: bool) -> None:
        """The life is over, and it is known what follows: tell whom it concerns here."""
        last, self._last = self._last, None
        if last is None or cell.state is not RUNNING:
            return
        running, ordered, noticed = last
        recovers = recovers and self.recovers(reason)
        self.over(cell, running, str(reason), ordered=ordered, noticed=noticed, reason=reason, recovers=recovers)
        if is_unkept(self.method) and self.switch is not None:
            forget_later(self.switch, str(reason))
        cell.extra().suspended = 0
        self.ended_below(cell, reason, recovers=recovers)

    # -- what a host does -------------------------------------------------------------------------------------------

    def start(self, cell: Cell) -> asyncio.Future[None]:
        raise HoldfastError(f"{cell.path} is started by its supervisor, which is in another process")

    def kill(self, cell: Cell) -> None:
        if self._last is None:  # Else it has ended already.
            super().kill(cell)

    def told(self, cell: Cell, verb: str, data: dict[str, Any]) -> None:
        if verb == "gone":
            self.place.told(cell, verb, data)
        else:
            super().told(cell, verb, data)

    def retired(self, cell: Cell) -> None:
        self._wanted = None
        super().retired(cell)
        left = self.left()
        if left:
            asyncio.gather(*left, return_exceptions=True).add_done_callback(lambda _: self.place.vacate(cell))
        else:
            self.place.vacate(cell)

    def is_restarting(self, cell: Cell) -> bool:
        return self.place.restarting

    def topics(self, cell: Cell) -> Iterable[str]:
        return self._topics

    def recipe(self, cell: Cell) -> Start[Any] | bytes:
        return self._recipe

    async def adapt(
        self,
        cell: Cell,
        mechanism: Any,
        switched: Callable[[], None],
        rest_within: float = REST_WITHIN,
        gate: Gate | None = None,
    ) -> Reconfiguration:
        def also_there() -> None:
            switched()
            self._say_spec()

        return await super().adapt(cell, mechanism, also_there, rest_within, gate)

    def respecified(self, cell: Cell) -> None:
        super().respecified(cell)
        self._say_spec()

    def _say_spec(self) -> None:
        """The supervisor in the process starts its next lives with the stack that there is now."""
        if self._port is not None:
            self._port.to_life(Respec(self.described()))


def subtree_group(place: SubtreeHome, cell: Cell, wanted: Wanted, before: Any) -> SubtreeGroup:
    """The host of the life that is wanted: that of the last one, if nothing has changed.

    Raises:
        HoldfastError: it cannot be protected so.
    """
    made = wanted.protected
    assert made is not None
    layers = tuple(map(known, msgspec.convert(made.layers, list[Description])))
    check_stack(layers, None, cell.path)
    problem = place.homes.refuses(wanted.method)
    if problem:
        raise StartFailed(cell.path, problem)
    spec = recipe_spec(cell)
    if spec is not None and pack_recipe(spec.start, cell.path) == made.recipe:
        cell.spec = dataclasses.replace(spec, mechanism=layers[0] if len(layers) == 1 else layers)
        cell.extra().start = spec.start
    if isinstance(before, SubtreeGroup) and describe(before.layers) == describe(layers):
        before.method = wanted.method
        return before
    return SubtreeGroup(place, wanted.method, layers)


def known(description: Description) -> Mechanism:
    """The mechanism that is meant, if its code is here already: nothing is imported for an actor process.

    Raises:
        MechanismRefused: it is not.
    """
    for kind in (description.kind, *(code.kind for _, _, code in description.bricks)):
        module = kind.partition(":")[0]
        if module not in sys.modules and module not in COMMON:
            why = "the root has not loaded it, and loads nothing that an actor process names: import it there"
            raise MechanismRefused(kind, why)
    whole = Code(description.kind, description.file, description.sha256)
    for code in (whole, *(code for _, _, code in description.bricks)):
        file = getattr(sys.modules.get(code.kind.partition(":")[0]), "__holdfast_file__", ("", ""))
        if code.file and (code.file, code.sha256) != file:
            raise MechanismRefused(code.kind, "the root has not loaded that file, nor does it for a process")
    return revive(description)
