"""Keeps a generated model true while the system changes: children that are added, moved, or taken away."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Final

from ..actors.kernel.actor import Actor, on
from ..actors.kernel.message import Message
from .generate import LiveWiring, replace, replicas_of
from .live_limits import LimitsOf, LiveLimits
from .model import Declaration, Replace
from .model_server import ChangeModel, ModelServer
from .observers.node_observer import at_root

EVERY: Final = 1.0
"""Seconds between two looks at the tree."""


class Reach:
    """Holds where repair finds the components; repair goes by it, and the follower keeps it true.

    Attributes:
        addresses: component to address.
        above: component to the supervisor that can be restarted with it; the root cannot.
        groups: component that stands for replicas to the address of the protected actor.
    """

    def __init__(self, root: str, given: Mapping[str, str]) -> None:
        self._root, self._given = root, dict(given)
        self.addresses: dict[str, str] = {}
        self.above: dict[str, str] = {}
        self.groups: dict[str, str] = {}

    def use(self, found: Mapping[str, str]) -> None:
        """Have repair go by these addresses from its next step on; those that a person has given stay."""
        replace(self.addresses, {**found, **self._given})
        above = {component: path.rpartition("/")[0] for component, path in self.addresses.items()}
        replace(self.above, {component: path for component, path in above.items() if path not in ("", self._root)})
        groups = {replicas_of(component): path for component, path in self.addresses.items()}
        replace(self.groups, {name: path for name, path in groups.items() if name not in self.addresses})


class _LookAgain(Message):
    """It is time to compare the model with the tree."""


class ModelFollower(Actor):
    """Compares the generated model with the live tree each second, and changes it where they differ.

    Args:
        wiring: what observers note, and what they go by.
        limits: those of properties, by which their observer goes.
        server: the last part of the model server's address, beside this actor.
        adapt: completes a generated declaration; it is given the components and their limits, too.
        reach: what repair goes by.
    """

    deterministic = False

    def __init__(
        self,
        wiring: LiveWiring,
        limits: LiveLimits,
        server: str,
        adapt: Callable[[Declaration, Iterable[str], LimitsOf], Declaration],
        reach: Reach,
    ) -> None:
        self._wiring, self._limits, self._server, self._adapt, self._reach = wiring, limits, server, adapt, reach

    def on_start(self, restored: bool) -> None:
        """Begin to look. Raises SpecError in a process of its own."""
        at_root(self)
        self.ctx.every(EVERY, _LookAgain())

    @on(_LookAgain)
    async def _look(self, message: _LookAgain) -> None:
        node, known = self.ctx._cell.node, self._wiring.found
        found = self._wiring.look_again(node) or known
        limits = self._limits.look_again(found.addresses)
        if found is not known or limits != self._limits.applied:
            path = f"{self.ctx.path.rpartition('/')[0]}/{self._server}"
            declaration = self._adapt(found.declaration, found.addresses, limits)
            change = ChangeModel((Replace(declaration),), "the system has changed")
            await self.ctx.find(path, ModelServer).ask(change)
            self._wiring.use(found)
            self._reach.use(found.addresses)
        self._limits.use(limits, node, found.addresses)
