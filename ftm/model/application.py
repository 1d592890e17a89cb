"""The application part (A) of the change model, read from an actor's class."""

from __future__ import annotations

import inspect
from typing import Any

import msgspec

from ...actors.errors import UnsavableValue, type_name
from ...actors.kernel.actor import Actor
from ...actors.values import encode_value


class Application(msgspec.Struct, frozen=True):
    """The properties of a protected actor that mechanisms depend on.

    Args:
        name: of its class.
        version: of its code and state, as it says itself.
        is_deterministic: the same inputs lead to the same outputs and states.
        has_state_access: its state can be taken and put back (which is so if it has none).
        has_delta: it can say what has changed since the last time.
        assertions, versions: how many it brings with it.
        why_no_state: why its state cannot be had, in words.
        state_bytes, delta_bytes, request_bytes: sizes; 0 where nothing is known.
        rate: requests per second that have to be served.
        turn_seconds: what one of them takes to compute.
    """

    name: str = ""
    version: str = "1"
    is_deterministic: bool = True
    has_state_access: bool = True
    has_delta: bool = False
    assertions: int = 0
    versions: int = 1
    why_no_state: str = ""
    state_bytes: int = 0
    delta_bytes: int = 0
    request_bytes: int = 0
    rate: float = 0.0
    turn_seconds: float = 0.0

    @classmethod
    def of(cls, kind: type[Actor], *, sample: Any = None, **known: Any) -> Application:
        """Read what a class says of itself.

        Determinism is its `deterministic`. Its state can be had unless it says `state_access = False`: by
        `get_state`/`set_state`, or as its key variables. `assertions` and `versions` are class attributes that list
        functions or classes; `version` (or `schema_version`) is a class attribute.

        Args:
            kind: the class of the actor.
            sample: a living instance: its state is encoded, which shows whether it can be, and how large it is.
            known: what is known otherwise and goes before what the class says: `rate=100.0`.
        """
        why = _no_state(kind)
        size = 0
        if sample is not None and not why:
            why, size = _encoded_size(sample)
        said: dict[str, Any] = {
            "name": type_name(kind),
            "version": str(getattr(kind, "version", None) or kind.schema_version),
            "is_deterministic": kind.deterministic,
            "has_state_access": not why,
            "why_no_state": why,
            "has_delta": _has(kind, "get_delta", "apply_delta"),
            "assertions": len(getattr(kind, "assertions", ())),
            "versions": max(1, len(getattr(kind, "versions", ()))),
            "state_bytes": size,
        }
        return cls(**{**said, **known})

    @property
    def saved_bytes(self) -> int:
        """Return the bytes of the state that are to be sent after a request."""
        return self.delta_bytes if self.has_delta else self.state_bytes

    def lack(self, need: str) -> str:
        """Say in words why a need is not met; empty if it is."""
        match need:
            case "determinism":
                return "" if self.is_deterministic else f"{self.name or 'it'} says deterministic = False"
            case "state_access":
                why = self.why_no_state or f"the state of {self.name or 'it'} cannot be had"
                return "" if self.has_state_access else why
            case "assertions":
                return "" if self.assertions else f"{self.name or 'it'} has none"
            case "versions":
                return "" if self.versions > 1 else f"{self.name or 'it'} has only one"
            case _:
                raise ValueError(f"unknown need {need!r}")


def _no_state(kind: type[Actor]) -> str:
    if not kind.state_access:
        return f"{type_name(kind)} says state_access = False"
    getters = [name for name in ("get_state", "set_state") if _has(kind, name)]
    if len(getters) == 1:
        return f"{type_name(kind)} has {getters[0]} without its counterpart"
    return ""


def _has(kind: type, *names: str) -> bool:
    return all(inspect.isroutine(inspect.getattr_static(kind, name, None)) for name in names)


def _encoded_size(sample: Any) -> tuple[str, int]:
    kind: Any = type(sample)
    if _has(kind, "get_state"):
        state: Any = sample.get_state()
    else:
        attributes: dict[str, Any] = vars(sample)
        keys = kind.key_variables
        if keys is None:
            keys = [key for key in attributes if not key.startswith("_") and key != "ctx"]
        state = {key: attributes[key] for key in keys if key in attributes}
    try:
        return "", len(encode_value(state, where=type_name(kind)))
    except UnsavableValue as error:
        return str(error), 0
