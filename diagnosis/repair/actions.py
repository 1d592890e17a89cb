"""Repair actions: a coroutine, and the PDDL text that says when it can be done and what it brings about.

A new one is one decorated coroutine:

    @repair.action("(:action reset_usb :parameters (?d - device) :precondition (bad ?d) "
                   ":effect (and (good ?d) (not (bad ?d))))")
    async def reset_usb(act: repair.Act, device: str) -> None:
        ...

It returns when it is done, and raises when it could not be. Whether it has helped is seen from observations, never from
its return (T60): effects that can be observed, such as `(on ?h)`, are waited for; `good` and `bad` are for the next
diagnosis to say.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Awaitable, Callable, Iterable, Mapping
from typing import Any, Final

from ...actors.errors import HoldfastError
from ...actors.kernel.context import ActorContext
from ..planning import Domain, PlanningError, Step, read_domain, repair_domain, with_actions
from ..planning.language import Action, And, Atom, Fact
from ..planning.repair import repair_text

ALLOWED: Final = "may-"
"""Before an action's name: the static predicate that lets it be done to a component now."""


@dataclasses.dataclass(frozen=True, slots=True)
class Act:
    """One execution, for the coroutine that carries it out.

    Attributes:
        step: what is done to what.
        epoch: of the arbiter's grant: hand it to whom you order something, so that a late order is refused.
        reason: why, in words.
        ctx: of the repairer: to find actors and to publish.
        check: raises GrantLost when somebody else has taken the actor; call it between two parts of long work.
    """

    step: Step
    epoch: int
    reason: str
    ctx: ActorContext
    check: Callable[[], None]


class ActionFailed(HoldfastError, text="{action}: {why}"):
    """An action could not be done: `why` in words."""

    action: str
    why: str


Undo = Callable[[], Awaitable[None]]
"""Takes back what an action has done, when it is seen that it has not helped."""
Run = Callable[..., Awaitable[Undo | None]]
"""`async def run(act, *names)`; it returns how to undo it, or None if that cannot be."""


def everyone(component: str) -> bool:
    """The action can be done to every component of the right type."""
    return True


@dataclasses.dataclass(frozen=True, slots=True)
class RepairAction:
    """What can be done. Made by `action`, or by a function of `stock.py`.

    Attributes:
        name: as in the PDDL text.
        run: does it.
        pddl: one `(:action ...)`; empty if the domain that comes with holdfast has it.
        timeout: seconds in which it must return.
        effect_timeout: seconds in which its effects must be observed after that.
        cool_down: seconds between two attempts on a component; None is what the policy says.
        attempts: on a component, until it is given up; None is what the policy says.
        grace: seconds after its end in which observers blame neither the component nor what depends on it; 0 if its
            effect is that something does not hold.
        is_dangerous: a person has to approve, unless the policy allows the action by its name.
        is_restart: it ends a life: whoever answers is restarted only when the diagnosis stands, and once.
        takes: whether it can be done to a component, its first parameter.
        reach: the address it acts on; None is the component's own.
    """

    name: str
    run: Run
    pddl: str = ""
    timeout: float = 10.0
    effect_timeout: float = 10.0
    cool_down: float | None = None
    attempts: int | None = None
    grace: float = 0.0
    is_dangerous: bool = False
    is_restart: bool = False
    takes: Callable[[str], bool] = everyone
    reach: Callable[[str], str | None] | None = None

    def __post_init__(self) -> None:
        for field in ("timeout", "effect_timeout"):
            if not 0 < getattr(self, field) < float("inf"):
                raise ValueError(f"{self.name}: {field} must be a finite number of seconds > 0")
        if self.attempts is not None and self.attempts < 1:
            raise ValueError(f"{self.name}: attempts must be >= 1")

    async def __call__(self, act: Act, *names: str) -> Undo | None:
        """Do it, as the coroutine itself would."""
        return await self.run(act, *names)


def action(pddl: str, **options: Any) -> Callable[[Run], RepairAction]:
    """Make a coroutine a repair action.

    Args:
        pddl: one `(:action name ...)` form; its parameters are the coroutine's, behind `act`. `(increase (total-cost)
            n)` among its effects makes others come first.
        options: those of `RepairAction`.

    Raises:
        PlanningError: the text is not valid.
    """
    name = _name_of(pddl)

    def make(run: Run) -> RepairAction:
        return RepairAction(name, run, pddl, **options)

    return make


def _name_of(pddl: str) -> str:
    before = {one.name for one in repair_domain().actions}
    named = [one.name for one in repair_domain(pddl).actions if one.name not in before]
    if len(named) != 1:
        raise PlanningError("action", f"the text must define one action, not {', '.join(named) or 'none'}")
    return named[0]


class Repertoire:
    """All that can be done, as a domain in which nothing else can be.

    Args:
        actions: with different names.
        more: PDDL text with further `(:types ...)` and `(:predicates ...)`.

    Raises:
        PlanningError: an action's text is not valid, two have the same name, or one has no text and is not among
            those that come with holdfast.
    """

    def __init__(self, actions: Iterable[RepairAction], *more: str) -> None:
        self.actions: Mapping[str, RepairAction] = {}
        named: dict[str, RepairAction] = {}
        for one in actions:
            if one.name in named:
                raise PlanningError(f"action {one.name}", "it is there twice")
            named[one.name] = one
        self.actions = named
        texts = [one.pddl for one in named.values() if one.pddl]
        whole = read_domain(with_actions(repair_text(), *more, *texts))
        known = {one.name for one in whole.actions}
        if unknown := sorted(set(named) - known):
            raise PlanningError(f"action {unknown[0]}", "it has no PDDL text")
        self.domain = _guarded(whole, named)

    def __getitem__(self, name: str) -> RepairAction:
        return self.actions[name]

    def allowed(self, names: Iterable[str], may: Callable[[RepairAction, str], bool]) -> Iterable[Atom]:
        """The facts that let actions be done to these components, as far as `may` says so."""
        components = list(names)
        for action in self.domain.actions:
            ours = self.actions[action.name]
            if not action.parameters:
                if may(ours, ""):
                    yield (ALLOWED + action.name,)
                continue
            for name in components:
                if ours.takes(name) and may(ours, name):
                    yield (ALLOWED + action.name, name)


def _guarded(domain: Domain, actions: Mapping[str, RepairAction]) -> Domain:
    """The domain with our actions only, each of which must be allowed for the first of its parameters."""
    kept = tuple(_guard(one) for one in domain.actions if one.name in actions)
    more = tuple((ALLOWED + one.name, tuple(("object",) for _ in one.parameters[:1])) for one in kept)
    return dataclasses.replace(domain, actions=kept, predicates=(*domain.predicates, *more))


def _guard(action: Action) -> Action:
    atom: Atom = (ALLOWED + action.name, *(one.name for one in action.parameters[:1]))
    return dataclasses.replace(action, precondition=And((Fact(atom), action.precondition)))
