"""The object that the body of a transaction calls: it collects operations, carried out when the body ends."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from ...actors.control.orders import Change as StateChange
from ...actors.kernel.actor import Actor, Start
from ...actors.kernel.ref import Target
from ...supervision.spec import ChildSpec, Isolation, Strategy
from . import living
from .living import Bind, RegisterName, Unbind, UnregisterName
from .mechanisms import Isolate, OnProtection, Protect, Update
from .operation import Operation, Step, described_steps, text_of
from .reparenting import Reparent
from .running import Respecify, StartAgain, StopChild
from .structure import AddChild, RemoveActor, Reorder, SetFlags, named_spec

if TYPE_CHECKING:
    from ...ftm.events import MechanismSettled
    from ...ftm.model.composition import Layer
    from ..system import ActorSystem


class Change:
    """Collects operations. A target is a ref, or an address as it is at that point: a step before may have added it."""

    def __init__(self, system: ActorSystem) -> None:
        self._system = system
        self._operations: list[Operation] = []
        self._added: set[str] = set()
        self._before: list[str] | None = None
        self._difference: list[str] | None = None
        self._lost: tuple[str, ...] = ()

    # -- the shape of the tree ----------------------------------------------------------------------------------------

    def add(self, supervisor: Target, spec: ChildSpec | Start[Any]) -> str:
        """Start one more child; returns its address. Under a dynamic supervisor it may come without an id."""
        spec = named_spec(supervisor, spec, self._added, self._system)
        path = f"{text_of(supervisor)}/{spec.id}"
        self._added.add(path)
        self.step(AddChild(supervisor, spec))
        return path

    def remove(self, target: Target) -> None:
        """Stop an actor for good. Its address is free when the transaction is over."""
        self.step(RemoveActor(target))

    def stop(self, target: Target) -> None:
        """Stop a child, and keep its spec: it can be started again. What was recorded of it stays."""
        self.step(StopChild(target))

    def start(self, supervisor: Target, name: str) -> str:
        """Start a child again that was stopped; returns its address."""
        self.step(StartAgain(supervisor, name))
        return f"{text_of(supervisor)}/{name}"

    def move(self, target: Target, to_supervisor: Target) -> None:
        """Put a child under another supervisor: it lives on, its refs stay good, its address changes."""
        self.step(Reparent(target, to_supervisor))

    def reorder(self, supervisor: Target, ids: Iterable[str]) -> None:
        """Give children another start order; those that are not named come behind."""
        self.step(Reorder(supervisor, list(ids)))

    def strategy(self, supervisor: Target, strategy: Strategy) -> None:
        """Restart by another strategy from now on."""
        self.step(SetFlags(supervisor, strategy=strategy))

    def intensity(self, supervisor: Target, intensity: int, period: float) -> None:
        """Allow this many restarts within `period` seconds from now on."""
        self.step(SetFlags(supervisor, intensity=intensity, period=period))

    def isolation(self, target: Target, isolation: Isolation) -> None:
        """Have an actor live in a process of its own, or as a task."""
        self.step(Isolate(target, isolation))

    def respecify(self, target: Target, **options: Any) -> None:
        """Have a child restarted and stopped by other options from now on.

        Args:
            target: the child.
            options: restart, shutdown, backoff, significant, start_timeout, rules, register: as `child` takes them. The
                life that is lived now keeps the names that it has.
        """
        self.step(Respecify(target, options))

    # -- what connects actors -----------------------------------------------------------------------------------------

    def bind(self, owner: Target, port: str, target: Target) -> None:
        """Point a binding elsewhere, from the owner's next turn on."""
        self.step(Bind(owner, port, target))

    def unbind(self, owner: Target, port: str) -> None:
        """Point a binding nowhere, from the owner's next turn on."""
        self.step(Unbind(owner, port))

    def register(self, name: str, target: Target) -> None:
        """Give an actor a name beside its address."""
        self.step(RegisterName(name, target))

    def unregister(self, name: str) -> None:
        """Free a name that an actor has beside its address."""
        self.step(UnregisterName(name))

    # -- live actors --------------------------------------------------------------------------------------------------

    def suspend(self, target: Target) -> None:
        """Have an actor handle no message until it is resumed."""
        self.step(living.SuspendActor(target))

    def resume(self, target: Target) -> None:
        """Have it handle messages again."""
        self.step(living.ResumeActor(target))

    def replace_state(self, target: Target, change: StateChange) -> None:
        """Put `change(state)` in the place of an actor's state; its messages wait until the transaction is over."""
        self.step(living.ReplaceActorState(target, change))

    def replace_code(self, target: Target, new: type[Actor] | Start[Any], change: StateChange | None = None) -> None:
        """Go on as another class; its messages wait until the transaction is over."""
        self.step(living.ReplaceActorCode(target, new, change))

    # -- fault tolerance ----------------------------------------------------------------------------------------------

    def protect(self, target: Target, stack: Layer | Sequence[Layer] | None) -> None:
        """Have an actor protected by just this stack of mechanisms, whatever it has now; its life goes on.

        Only the bricks that differ from those that it has are touched.

        Args:
            target: the actor.
            stack: one mechanism or several, outermost first; None or an empty sequence: none. Each is one such as
                `PBR()`, the name of one, or a file or module that defines one. The name of one that the actor has
                means that one, with its settings: `("pbr", TR())` adds one inside.
        """
        self.step(Protect(target, stack))

    def update(self, target: Target, brick: str, new: Any, *, mechanism: str = "", role: str = "") -> None:
        """Give one brick new code.

        Args:
            target: the protected actor.
            brick: before, proceed or after.
            new: its new class, or a file that defines one (`file.py`, `file.py:Name`).
            mechanism: the name of the mechanism, if several of the actor's have such a brick.
            role: that in which it is another one, if the mechanism has it in several: "primary".
        """
        self.step(Update(target, brick, new, mechanism=mechanism, role=role))

    # -- all of it ----------------------------------------------------------------------------------------------------

    def step(self, operation: Operation) -> None:
        """Collect one more operation, of whatever kind."""
        self._operations.append(operation)

    @property
    def operations(self) -> tuple[Operation, ...]:
        """Return the operations that were collected so far."""
        return tuple(self._operations)

    @property
    def steps(self) -> tuple[Step, ...]:
        """Return the steps of the transaction, in the order in which they are taken."""
        return tuple(Step(n, one.verb, one.target, one.text, one.note) for n, one in enumerate(self._operations, 1))

    async def settled(self) -> tuple[MechanismSettled, ...]:
        """Wait until it is known whether the mechanisms that this transaction has changed stay.

        A new stack of mechanisms is on probation for some seconds: if it ends a replica, or lets nothing pass, the one
        before comes back. Called behind the transaction; one for each address, in the order of the steps.
        """
        on_probation = [one.probation for one in self._operations if isinstance(one, OnProtection)]
        return tuple([await asyncio.shield(one.settled) for one in on_probation if one is not None])

    @property
    def difference(self) -> tuple[str, ...]:
        """List how the tree changes: lines with `-` go, lines with `+` come. Known after the checks."""
        return tuple(self._difference or ())

    @property
    def lost(self) -> tuple[str, ...]:
        """Name what of recorded states is left behind, in sentences, as whoever planned the steps has found."""
        return self._lost

    def lose(self, what: Iterable[str]) -> None:
        """Note what is left behind by the steps, in sentences, for those who are asked before."""
        self._lost = (*self._lost, *what)

    def describe(self) -> str:
        """Say in words which steps there are, and how the tree changes (known after the checks)."""
        return "\n".join([*described_steps(self.steps), *(self._difference or ())])
