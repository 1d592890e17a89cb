"""The specification of a tree as plain data, and what each operation of a transaction makes of it.

It knows nothing of the library: a machine that drives a real system compares the two.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterator
from typing import Any, Literal

ROOT = 0
Kind = Literal["Tally", "Twice", "supervisor", "dynamic"]
STRATEGIES = ("one_for_one", "one_for_all", "rest_for_one")


class Cannot(Exception):
    """A step does not fit the specification at its point."""


@dataclasses.dataclass
class Node:
    """One actor. `who` is its identity: an actor that is moved keeps it, and a newcomer at its address has another."""

    who: int
    name: str
    above: int
    kind: Kind = "Tally"
    is_recorded: bool = False
    is_late: bool = False
    """Whether its start takes a while."""
    isolation: Literal["task", "process"] = "task"
    is_stopped: bool = False
    is_suspended: bool = False
    names: set[str] = dataclasses.field(default_factory=set)
    peer: int | None = None
    """To whom it is bound now."""
    spec_peer: int | None = None
    """To whom its spec binds it."""
    states: int = 0
    """How often its state was replaced."""
    below: list[int] = dataclasses.field(default_factory=list)
    strategy: str = "one_for_one"
    intensity: int = 1000
    period: float = 5.0

    @property
    def is_supervisor(self) -> bool:
        """Whether it looks after children."""
        return self.kind in ("supervisor", "dynamic")


@dataclasses.dataclass(frozen=True)
class Step:
    """One operation. Its arguments are identities where the operation takes an address or a ref."""

    verb: str
    args: tuple[Any, ...] = ()

    def __str__(self) -> str:
        return f"{self.verb}{self.args}"


class Spec:
    """The specification in force."""

    def __init__(self) -> None:
        self.nodes: dict[int, Node] = {ROOT: Node(ROOT, "app", ROOT, "supervisor")}
        self.free: set[str] = set()
        """Addresses at which a plain actor has lived that was removed or moved away."""
        self.leaving: set[int] = set()
        """Who was removed by an earlier step of the transaction that is being applied."""
        self.planned: set[int] = set()
        """Who was added by an earlier step of it."""
        self.left: set[str] = set()
        """Addresses that an earlier step of it has moved somebody away from, who was there before it."""
        self.late: set[int] = set()
        """Who was added there, or bound by its spec to such a one: started only when the transaction is in force."""
        self.reworked: set[int] = set()
        """Whose state an earlier step of it has replaced."""
        self.relocated: set[int] = set()
        """Who is to live elsewhere by an earlier step of it."""
        self.halted: set[int] = set()
        """Who is stopped by an earlier step of it."""
        self.roused: set[int] = set()
        """Who is started by an earlier step of it: nobody is below it before that."""

    def copy(self) -> Spec:
        """The same specification, to be changed."""
        return copy.deepcopy(self)

    # -- reading ------------------------------------------------------------------------------------------------------

    def path(self, who: int) -> str:
        """The address of an actor."""
        node = self.nodes[who]
        return f"/{node.name}" if who == ROOT else f"{self.path(node.above)}/{node.name}"

    def walk(self, who: int) -> Iterator[Node]:
        """An actor and all below it, parents first."""
        node = self.nodes[who]
        yield node
        for one in node.below:
            yield from self.walk(one)

    def upwards(self, who: int) -> Iterator[Node]:
        """An actor and all above it, but the root."""
        while who != ROOT:
            yield self.nodes[who]
            who = self.nodes[who].above

    def is_running(self, who: int) -> bool:
        """Whether it has a life: neither it nor anybody above it is stopped."""
        return who in self.nodes and not any(node.is_stopped for node in self.upwards(who))

    def is_leaving(self, who: int) -> bool:
        """Whether an earlier step removes it."""
        return any(node.who in self.leaving for node in self.upwards(who))

    def leaves(self) -> list[Node]:
        """All who are no supervisors, by identity."""
        return [node for _, node in sorted(self.nodes.items()) if not node.is_supervisor]

    def supervisors(self) -> list[Node]:
        """All supervisors but the root, by identity."""
        return [node for who, node in sorted(self.nodes.items()) if node.is_supervisor and who != ROOT]

    def tree(self) -> list[str]:
        """The addresses at which somebody lives."""
        return [self.path(node.who) for node in self.walk(ROOT) if self.is_running(node.who)]

    def holder(self, name: str) -> Node | None:
        """Who has a name."""
        return next((node for node in self.nodes.values() if name in node.names), None)

    def bound_into(self, who: int) -> Iterator[tuple[Node, Node]]:
        """Bindings that lead from outside to an actor or somebody below it: owner and target."""
        inside = {node.who for node in self.walk(who)}
        for owner in self.nodes.values():
            for target in {owner.peer, owner.spec_peer} & inside:
                if owner.who not in inside and target is not None and not self.is_leaving(owner.who):
                    yield owner, self.nodes[target]

    def starts_first(self, who: int, other: int) -> bool:
        """Whether a supervisor of both, below the root, starts the first one before the other."""
        order = [node.who for node in self.walk(ROOT)]
        tops = {list(self.upwards(one))[-1].who for one in (who, other)}
        return len(tops) == 1 and order.index(who) < order.index(other)

    def starts_alone(self) -> bool:
        """Whether no supervisor at the top waits for another one for more than an instant when both are restarted."""
        tops = self.nodes[ROOT].below
        led = [
            (tops.index(list(self.upwards(one))[-1].who), tops.index(list(self.upwards(node.who))[-1].who))
            for node in self.nodes.values()
            if (one := node.spec_peer) is not None
        ]
        late = {tops.index(list(self.upwards(node.who))[-1].who) for node in self.nodes.values() if node.is_late}
        return all(to == of or (to < of and to not in late) for to, of in led)

    def ended_with(self, who: int) -> set[int]:
        """Whose lives may end when that of one ends: those below it, and its group by its supervisor's strategy."""
        above = self.nodes[self.nodes[who].above]
        top = above.below if above.strategy != "one_for_one" else [who]
        return {node.who for one in top for node in self.walk(one)}

    # -- changing -----------------------------------------------------------------------------------------------------

    def apply(self, steps: list[Step]) -> Spec:
        """The specification after a transaction with these steps.

        Raises:
            Cannot: one of them does not fit.
        """
        after = self.copy()
        for step in steps:
            after.do(step)
        after.end()
        return after

    def do(self, step: Step) -> None:
        """Change the specification by one step. Raises Cannot."""
        getattr(self, f"_{step.verb}")(*step.args)

    def end(self) -> None:
        """The transaction is complete: who was removed is gone. Raises Cannot."""
        for who in self.leaving:
            if any(True for _ in self.bound_into(who)):
                raise Cannot(f"a binding would point at {who}, which is removed")
        for who in self.leaving:
            self._forget(who)
        for one in self.nodes.values():
            if one.spec_peer is not None and self.starts_first(one.who, one.spec_peer):
                raise Cannot(f"the spec of {one.who} would bind to who is started later")
        self.leaving.clear()
        self.planned.clear()
        self.left.clear()
        self.late.clear()
        self.reworked.clear()
        self.relocated.clear()
        self.halted.clear()
        self.roused.clear()

    def _forget(self, who: int) -> None:
        if who not in self.nodes:
            return  # It was below another one that is gone.
        node, gone = self.nodes[who], list(self.walk(who))
        self.nodes[node.above].below.remove(who)
        if not node.is_supervisor and not node.is_recorded:
            self.free.add(self.path(who))
        for one in gone:
            del self.nodes[one.who]

    def _existing(self, who: int) -> Node:
        if who not in self.nodes or self.is_leaving(who):
            raise Cannot(f"{who} is not there")
        for above in self.upwards(self.nodes[who].above):
            if above.who in self.roused or (above.is_stopped and above.who not in self.halted):
                raise Cannot(f"{above.who} was stopped before, and nobody is below it")
        return self.nodes[who]

    def _living(self, who: int) -> Node:
        node = self._existing(who)
        if not self.is_running(who):
            raise Cannot(f"{who} is stopped")
        return node

    def _leaf(self, who: int) -> Node:
        node = self._living(who)
        if node.is_supervisor:
            raise Cannot(f"{who} is a supervisor")
        return node

    def _leaf_before(self, who: int) -> Node:
        """One that lives before the transaction is in force."""
        if who in self.late:
            raise Cannot(f"{who} is started when all is in force")
        return self._leaf(who)

    def _supervisor(self, who: int) -> Node:
        node = self._living(who)
        if not node.is_supervisor:
            raise Cannot(f"{who} is no supervisor")
        return node

    def _old(self, who: int) -> Node:
        if who in self.planned:
            raise Cannot(f"{who} is added by the same transaction")
        return self._existing(who)

    def _is_taken(self, above: Node, name: str) -> bool:
        return any(self.nodes[one].name == name for one in above.below)

    def _add(self, above: int, new: Node) -> None:
        supervisor = self._supervisor(above)
        if self._is_taken(supervisor, new.name) or new.who in self.nodes:
            raise Cannot(f"{new.name} is taken")
        if supervisor.kind == "dynamic" and new.is_supervisor:
            raise Cannot("the dynamic supervisor has plain children only")
        if new.spec_peer is not None:
            self._leaf(new.spec_peer)
        node = copy.deepcopy(new)
        node.above, node.peer, node.below = above, node.spec_peer, []
        self.nodes[node.who] = node
        supervisor.below.append(node.who)
        self.planned.add(node.who)
        if self.path(node.who) in self.left or new.spec_peer in self.late:
            self.late.add(node.who)
        self.free.discard(self.path(node.who))

    def _remove(self, who: int) -> None:
        self._old(who)
        if self.nodes[who].above == ROOT:
            raise Cannot("the supervisors at the top stay")
        self.leaving.add(who)

    def _stop(self, who: int) -> None:
        node = self._old(who)
        if not self.is_running(who) or node.above == ROOT or self.nodes[node.above].kind == "dynamic":
            raise Cannot(f"{who} cannot be stopped")
        if any(True for _ in self.bound_into(who)):
            raise Cannot(f"a binding would point at {who}, which is stopped")
        if any(one.who in self.reworked for one in self.walk(who)):
            raise Cannot(f"{who} has its new state until it is stopped, and then no more")
        node.is_stopped = True
        self.halted.add(who)
        self.lose(who)

    def _start(self, who: int) -> None:
        node = self._old(who)
        self._supervisor(node.above)
        if not node.is_stopped:
            raise Cannot(f"{who} runs")
        node.is_stopped = False
        self.roused.add(who)

    def lose(self, who: int) -> None:
        """What ends with a life. Where a binding leads when another one begins is found out then."""
        for one in self.walk(who):
            one.is_suspended, one.states = False, one.states if one.is_recorded else 0
            one.names.clear()

    def _move(self, who: int, to: int) -> None:
        node, new = self._old(who), self._supervisor(to)
        if node.above in (ROOT, to) or new.who in {one.who for one in self.walk(who)}:
            raise Cannot(f"{who} cannot be moved to {to}")
        if self._is_taken(new, node.name) or (new.kind == "dynamic" and (node.is_supervisor or node.is_stopped)):
            raise Cannot(f"{to} cannot take {who}")
        self._living(node.above)
        if not node.is_supervisor:
            self.free.add(self.path(who))
        self.left.add(self.path(who))
        self.nodes[node.above].below.remove(who)
        new.below.append(who)
        node.above = to
        self.free.discard(self.path(who))

    def _reorder(self, who: int, order: tuple[int, ...]) -> None:
        node = self._supervisor(who)
        if node.kind == "dynamic" or not set(order) <= set(node.below) or any(map(self.is_leaving, order)):
            raise Cannot("there is no such order")
        node.below = [*order, *(one for one in node.below if one not in order)]

    def _strategy(self, who: int, strategy: str) -> None:
        node = self._supervisor(who)
        if node.kind == "dynamic" and strategy != "one_for_one":
            raise Cannot("a dynamic supervisor is one_for_one")
        node.strategy = strategy

    def _intensity(self, who: int, intensity: int, period: float) -> None:
        node = self._supervisor(who)
        node.intensity, node.period = intensity, period

    def _isolation(self, who: int, isolation: Literal["task", "process"]) -> None:
        node = self._leaf(who)
        self._old(who)
        if self.nodes[node.above].kind == "dynamic":
            raise Cannot("its spec is not kept")
        node.isolation = isolation
        self.relocated.add(who)  # It lives where it did until the transaction is in force.

    def _bind(self, owner: int, target: int) -> None:
        if owner == target:
            raise Cannot("nobody is bound to itself")
        self._leaf(target)
        node = self._leaf(owner)
        node.peer = target
        if owner in self.planned and node.spec_peer is not None:
            node.spec_peer = target  # It is added so.

    def _unbind(self, owner: int) -> None:
        node = self._leaf_before(owner)
        if node.peer is None or node.spec_peer is not None or node.isolation == "process":
            raise Cannot("there is nothing to unbind")
        if owner in self.relocated:
            raise Cannot(f"{owner} lives in a process, which keeps a binding, or will")
        node.peer = None

    def _register(self, name: str, who: int) -> None:
        node = self._leaf_before(who)
        if self.holder(name) not in (None, node):
            raise Cannot(f"{name} is taken")
        node.names.add(name)

    def _unregister(self, name: str) -> None:
        holder = self.holder(name)
        if holder is None or self.is_leaving(holder.who):
            raise Cannot(f"nobody is {name}")
        holder.names.discard(name)

    def _suspend(self, who: int) -> None:
        self._leaf_before(who).is_suspended = True

    def _resume(self, who: int) -> None:
        self._leaf_before(who).is_suspended = False

    def _replace_state(self, who: int) -> None:
        self._leaf_before(who).states += 1
        self.reworked.add(who)

    def _replace_code(self, who: int, kind: Kind) -> None:
        self._leaf_before(who).kind = kind
