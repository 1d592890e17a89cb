"""A watch over one protected actor: its mechanism, its class, and changes by transactions."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from ...actors.errors import SpecError
from ...actors.kernel.node import cell_kind
from ...supervision.spec import ChildSpec
from ..model.application import Application
from ..model.change_model import resource_price
from ..model.composition import layers_of
from ..model.mechanism import compose
from .judge import Judge, Settings
from .monitor import ChangeStack, MechanismWatch

if TYPE_CHECKING:
    from ...actors.kernel.ref import ActorRef
    from ..model.change_model import Pricing, Resources
    from ..model.mechanism import Mechanism

PLAIN = ("pbr", "lfr", "tmr", "tr")
"""Mechanisms that need nothing but the actor itself."""
BRINGS = ("versions", "alternates")
"""Settings that name other versions of the actor."""
CHANGED_WITHIN = 30.0
"""Seconds that a change may take."""


def watch_of(
    system: Any,
    ref: ActorRef[Any],
    settings: Settings,
    *,
    mechanisms: Iterable[Any] = PLAIN,
    resources: Resources | None = None,
    known: dict[str, Any] | None = None,
    price: Pricing = resource_price,
    **options: Any,
) -> MechanismWatch:
    """Describe to a `MonitoringEngine` how to look after an actor, whose mechanism it changes by transactions.

    Args:
        system: the system that it lives in.
        ref: the actor, protected or not.
        settings: how quick and how stubborn.
        mechanisms: those that may be chosen, with their settings: instances, classes, names or files. Those that the
            actor has now are among them in any case.
        resources: what there is; measured, if it is left out.
        known: what is known of the application and its class does not say: `{"rate": 100.0}`.
        price: what is to be small: `resource_price`, `response_price`, `recovery_price`, or a function of your own, as
            in `select`.
        options: those of `MechanismWatch`: `probe`, `veto`, `degrade`, `signs`, `patience`.

    Raises:
        SpecError: no spec says what protects it: nobody supervises it. MechanismRefused: there is no such mechanism.
        TypeError: `price` is no function.
    """
    cell = ref._cell
    kind, spec = cell_kind(cell), cell.spec
    if kind is None or not isinstance(spec, ChildSpec):
        raise SpecError(ref.path, "it is not supervised, so no mechanism could be given to it")
    made: dict[str, Mechanism] = {}
    for one in mechanisms:
        made.update((layer.name, layer) for layer in layers_of(one))
    present = () if spec.mechanism is None else compose(spec.mechanism)
    made.update((layer.name, layer) for layer in present)

    async def change(adapt: ChangeStack) -> None:
        layers = tuple(made[name] for name in adapt.target)
        async with system.transaction(timeout=CHANGED_WITHIN) as step:
            step.protect(adapt.address, layers)

    assertions = sum(len(getattr(one, "assertions", ())) for one in made.values())
    versions = sum(len(getattr(one, name, ())) for one in made.values() for name in BRINGS)
    application = Application.of(kind, **{"assertions": assertions, "versions": 1 + versions, **(known or {})})
    judge = Judge(settings, application, tuple(one.name for one in present), list(made.values()), resources, price)
    watch = MechanismWatch(ref.path, judge, change, **options)
    watch.kind = kind
    return watch
