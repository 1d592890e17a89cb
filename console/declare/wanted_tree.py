"""What is wanted to run, whoever says so: a file, or the specs of a program."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Protocol

from ...actors.errors import SpecError
from ...supervision.spec import ChildSpec, Flags
from ...system.transaction.lasting import recipe_parts


@dataclasses.dataclass(frozen=True, slots=True)
class WantedActor:
    """What is wanted at one address."""

    path: str
    spec: ChildSpec | None
    """What its supervisor is to have; None for one that stays as it is, and for the root."""
    flags: Flags | None = None
    """Of a supervisor; None: as they are."""
    names: tuple[str, ...] | None = None
    """All names beside its address; None: whichever it has."""
    keeps_below: bool = False
    """Whether what is below it stays as it is."""

    @property
    def is_kept(self) -> bool:
        """Whether it stays as it is itself."""
        return self.keeps_below and self.spec is None

    @property
    def bindings(self) -> Mapping[str, str]:
        """Where its ports are to lead: address by port."""
        return self.spec.bindings if self.spec is not None else {}

    @property
    def is_running(self) -> bool:
        """Whether it is to run, rather than to be known and stopped."""
        return self.spec is None or self.spec.autostart

    @property
    def above(self) -> str:
        """The address of its supervisor."""
        return self.path.rpartition("/")[0]

    @property
    def id(self) -> str:
        """The last part of its address."""
        return self.path.rpartition("/")[2]


class WantedTree(Protocol):
    """All that is wanted below an address."""

    @property
    def below(self) -> str:
        """The address: what is below it, and not wanted, is removed."""
        ...

    @property
    def actors(self) -> Mapping[str, WantedActor]:
        """By address, in the order in which they are started."""
        ...

    def error(self, path: str, problem: str, key: str | None = None) -> SpecError:
        """An error that says where an actor is wanted."""
        ...


class WantedSpecs:
    """The specs of a program, as it gives them to `system.start`."""

    def __init__(self, system: str, specs: Iterable[ChildSpec], source: str) -> None:
        self.below, self._source = f"/{system}", source
        self.actors: dict[str, WantedActor] = {}
        for spec in specs:
            self._take(f"{self.below}/{spec.id}", spec)

    def _take(self, path: str, spec: ChildSpec) -> None:
        flags, children = recipe_parts(spec.start) if spec.is_supervisor else (None, ())
        self.actors[path] = WantedActor(path, spec, flags, keeps_below=children is None)
        for child in children or ():
            self._take(f"{path}/{child.id}", child)

    def error(self, path: str, problem: str, key: str | None = None) -> SpecError:
        """An error that names the program."""
        return SpecError(f"{self._source}, {path}{f', {key}' if key else ''}", problem)
