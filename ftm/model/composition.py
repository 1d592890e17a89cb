"""Checks a stack of mechanisms before it is run, and the way from one stack to another (T39, T42)."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from ...actors.errors import type_name
from ...actors.kernel.message import message_name
from .mechanism import Description, Mechanism, MechanismRefused, Part, Role, compose, find, load, load_module
from .mechanism_declaration import BadDeclaration, Entry

if TYPE_CHECKING:
    from ...actors.kernel.actor import Actor
    from ..bricks.bricks import Brick

ORDER = ("link", "assertion", "replication", "repetition")
"""Layers, outermost first: what is outside sees plain data, what is inside runs once for each replica."""
PARTS: tuple[Part, ...] = get_args(Part)
Layer = Mechanism | type[Mechanism] | str | os.PathLike[str]
"""A mechanism as a change takes it: an instance, a class without settings, a name, or a file."""


def layers_of(wanted: Any, there: Any = None) -> tuple[Mechanism, ...]:
    """Mechanisms as a change takes them: one or several, outermost first; each an instance, a class, a name or a file.

    The name of one that is `there` already means that one, with its settings.

    Raises:
        MechanismRefused: something is none, or cannot be loaded.
    """
    several: Iterable[Any] = wanted if isinstance(wanted, (tuple, list)) else (wanted,)
    known = {} if there is None else {layer.name: layer for layer in compose(there)}
    return compose(*(known[one] if isinstance(one, str) and one in known else _made(one) for one in several))


def _made(wanted: Any) -> Mechanism:
    if isinstance(wanted, os.PathLike):
        wanted = os.fspath(wanted)
    if isinstance(wanted, str):
        wanted = load(wanted) if wanted.endswith(".py") or "." in wanted else find(wanted)
    if isinstance(wanted, type) and issubclass(wanted, Mechanism):
        try:
            return wanted()
        except TypeError as error:
            raise MechanismRefused(wanted.name or type_name(wanted), f"it needs settings: {error}") from error
    if not isinstance(wanted, Mechanism):
        raise MechanismRefused(
            "a mechanism", f"it must be one such as PBR(), its name or its file, or several, not {wanted!r}"
        )
    return wanted


def check_stack(layers: tuple[Mechanism, ...], kind: type[Actor] | None, where: str) -> None:
    """Whether mechanisms go together in this order, and with the class that they are to protect.

    Raises:
        MechanismRefused: which one does not, and why.
    """
    from ..replica.replica import weave

    above: Mechanism | None = None
    for one in layers:
        check_declared(one)
        if above is not None and ORDER.index(one.layer) < ORDER.index(above.layer):
            why = f"({one.layer}) must stand outside of {above.name} ({above.layer}), not inside"
            raise MechanismRefused(one.name, f"it {why}")
        if above is not None and (why := _both(one, above)):
            raise MechanismRefused(one.name, why)
        others = [other for other in layers[: layers.index(one)] if 1 < other.replicas != one.replicas > 1]
        if others:
            why = f"it wants {one.replicas} replicas, and {others[0].name} outside of it {others[0].replicas}"
            raise MechanismRefused(one.name, why)
        above = one
        inside = one.over
        here = {other.layer for other in layers[layers.index(one) + 1 :]}
        if inside and not inside & here:
            raise MechanismRefused(one.name, f"a mechanism of the layer {', '.join(sorted(inside))} must stand inside")
        if kind is not None:
            one.check(kind, where)
    for leads in (True, False):
        weave(layers, leads=leads)


def check_declared(one: Mechanism) -> None:
    """Whether a mechanism says of itself what can be.

    Raises:
        MechanismRefused: it has no name or no replica, or names a fault, need, layer or level that there is not.
    """
    who = one.name or type_name(type(one))
    if not one.name or one.replicas < 1:
        problem = "a name" if not one.name else f"at least one replica, not {one.replicas}"
        raise MechanismRefused(who, f"it must declare {problem}")
    try:
        Entry.of(one)
    except BadDeclaration as error:
        raise MechanismRefused(who, str(error)) from error


def _both(one: Mechanism, above: Mechanism) -> str:
    """Why two of one layer do not go together; what masks nothing goes with all."""
    if one.layer != above.layer:
        return ""
    if one.name == above.name:
        return "it stands in the composition twice"
    if one.replicas > 1 and above.replicas > 1:
        return f"it wants {one.replicas} replicas, and {above.name} outside of it keeps replicas already"
    if one.tolerates and above.tolerates:
        return f"it and {above.name} are both of {one.layer}: two of them would work against each other"
    return ""


def describe(layers: Any) -> list[Description] | None:
    """Layers as they can be compared, kept and sent; None if there are none."""
    return None if layers is None else [layer.describe() for layer in compose(layers)]


def names_of(layers: Any) -> str:
    """The names of layers, outermost first, as one text."""
    return " + ".join(type_name(type(layer)).rpartition(".")[2] for layer in compose(layers))


def lines_of(path: str, layers: Any) -> list[str]:
    """The bricks of an address, a line for each that is a mechanism's own, by role."""
    found: list[str] = []
    for layer in compose(layers):
        for leads in (True, False) if len(layer.roles) > 1 else (True,):
            role, name = layer.role(leads=leads), layer.role_name(leads=leads)
            for part in PARTS:
                kind = getattr(role, part)
                if kind is not None:
                    settings = ", ".join(f"{key}={value!r}" for key, value in layer.describe().settings.items())
                    found.append(f"{path}/ftm {layer.name} {name} {part}: {message_name(kind)}({settings})")
    return found


# -- one stack becomes another ----------------------------------------------------------------------------------------


def updated(layers: Any, part: str, code: Any, *, mechanism: str, role: str) -> tuple[Mechanism, ...]:
    """One brick with other code, all others as they are.

    Args:
        layers: the stack.
        part: before, proceed or after.
        code: the class of the new brick, or a file with it (`file.py`, or `file.py:Name` if there are several).
        mechanism: whose brick, if there are several that have one.
        role: in which role, if the brick is another one in each.

    Raises:
        MechanismRefused: it is not clear which brick is meant, or the new one cannot stand there.
    """
    from ..replica.replica import PARTS as BASES
    from ..replica.replica import check_brick

    there = compose(layers)
    if part not in BASES:
        raise MechanismRefused("update", f"a brick is one of {', '.join(BASES)}, not {part!r}")
    found = [layer for layer in there if not mechanism or layer.name == mechanism]
    if not found:
        raise MechanismRefused(mechanism, f"it is not attached: {names_of(there)} is")
    if len(found) > 1:
        found = [layer for layer in found if any(getattr(one, part) is not None for one in _roles(layer).values())]
        if len(found) != 1:
            raise MechanismRefused("update", f"say which of {names_of(there)} is meant: mechanism={there[0].name!r}")
    (layer,) = found
    roles = _roles(layer)
    if role and role not in roles:
        raise MechanismRefused(layer.name, f"its roles are {', '.join(roles)}, not {role!r}")
    meant = [role] if role else [name for name, one in roles.items() if getattr(one, part) is not None] or list(roles)
    if len({getattr(roles[name], part) for name in meant}) > 1:
        raise MechanismRefused(layer.name, f"its {part} is another one as {' and as '.join(meant)}: say which role")
    kind = _brick(code, BASES[part])
    check_brick(layer, part, kind)
    new = layer
    for name in meant:
        new = new.with_brick(name, part, kind)
    return tuple(new if one is layer else one for one in there)


def _roles(layer: Mechanism) -> dict[str, Role]:
    return {layer.role_name(leads=leads): layer.role(leads=leads) for leads in (True, False)}


def _brick(code: Any, base: type[Brick]) -> type[Brick]:
    """The class of a new brick."""
    if isinstance(code, os.PathLike):
        code = os.fspath(code)
    if not isinstance(code, str):
        return code  # type: ignore[no-any-return]  # looked at by whoever calls
    file, _, name = code.partition(":")
    module = load_module(file)
    kinds = [
        value
        for value in vars(module).values()
        if isinstance(value, type) and issubclass(value, base) and value.__module__ == module.__name__
    ]
    kinds = [kind for kind in kinds if not name or kind.__name__ == name]
    if len(kinds) != 1:
        known = ", ".join(sorted(kind.__name__ for kind in kinds)) or "none"
        problem = f"it must define one {base.__name__}{f' called {name}' if name else ''}, and has: {known}"
        raise MechanismRefused(Path(file).name, problem)
    return kinds[0]
