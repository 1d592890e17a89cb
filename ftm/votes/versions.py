"""Versions: other classes or handlers that do what the protected actor does, with the same messages and state."""

from __future__ import annotations

from typing import Any

from ...actors.errors import type_name
from ...actors.kernel.actor import Actor, handled_by
from ...actors.process.wire.start_codec import imported
from ..model.mechanism import MechanismRefused


def version(kind: type[Actor], name: str, mechanism: str) -> type[Actor]:
    """The class of a version: one that is named, or `kind` with the handler that is named in place of its own.

    Raises:
        MechanismRefused: it cannot be imported, or has not the same messages, or its state cannot be had.
    """
    try:
        found: Any = imported(name)
    except Exception as error:  # Importing runs the module: anything may be raised.
        raise MechanismRefused(mechanism, f"{name} cannot be imported: {type_name(type(error))}: {error}") from error
    made = found if isinstance(found, type) else _with_handler(kind, found, name, mechanism)
    if not issubclass(made, Actor):
        raise MechanismRefused(mechanism, f"{name} is neither an actor class nor a handler")
    missing = sorted(type_name(one) for one in set(kind._declared) - set(made._declared))
    if missing:
        raise MechanismRefused(mechanism, f"{name} has no handler for {', '.join(missing)}")
    if not made.state_access:
        raise MechanismRefused(mechanism, f"{name} says state_access = False, and has to begin from the same state")
    return made


def _with_handler(kind: type[Actor], handler: Any, name: str, mechanism: str) -> type[Any]:
    handled = [one.kind for one in handled_by(handler)]
    if not handled:
        raise MechanismRefused(mechanism, f"{name} is neither an actor class nor a handler (@on)")
    body: dict[str, Any] = {}
    for one in handled:
        own = next((key for key in dir(kind) if one in _handles(kind, key)), None)
        if own is None:
            raise MechanismRefused(mechanism, f"{name} handles {type_name(one)}, and {type_name(kind)} does not")
        body[own] = handler
    return type(f"{kind.__name__}_{handler.__name__}", (kind,), {"__module__": kind.__module__, **body})


def _handles(kind: type[Actor], key: str) -> list[Any]:
    marks = handled_by(getattr(kind, key, None))
    return [one.kind for one in marks]
