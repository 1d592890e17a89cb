"""The base of fault-tolerance mechanisms: roles, their bricks, and assumptions. Each has its own file.

A mechanism is a frozen dataclass: its fields are its settings. It is found by name (`find`), by an entry point of the
group `holdfast.mechanisms`, or loaded from a file or module that the system has never seen (`load`).
"""

from __future__ import annotations

import copy
import dataclasses
import hashlib
import importlib
import importlib.util
import operator
import os
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self, TypeVar

import msgspec

from ...actors.errors import HoldfastError, type_name
from ...actors.kernel.actor import Actor
from ...actors.kernel.message import message_name
from ...actors.process.wire.start_codec import Described, imported
from .detection import Detection
from .mechanism_declaration import MechanismDeclaration

if TYPE_CHECKING:
    from ...actors.kernel.node import Node
    from ..bricks.bricks import After, Before, Brick, Proceed
    from ..bricks.sealed_frames import SecuredLink

M = TypeVar("M", bound="Mechanism")

Part = Literal["before", "proceed", "after"]
SCRIPTS = "holdfast_script_"
"""How the modules of reconfiguration scripts are called: only the process that runs the script has them by name."""
FILES = "holdfast_mechanism_"
"""How the modules of mechanisms are called that were loaded from a file."""
ENTRY_POINTS = "holdfast.mechanisms"
BUILT_IN = ("pbr", "lfr", "tr", "ad", "rb", "nvp", "tmr", "sec")
BUILT_IN_PACKAGE = f"{(__package__ or '').rpartition('.')[0]}.mechanisms"
COMMON = tuple(f"{BUILT_IN_PACKAGE}.{name}" for name in BUILT_IN if name != "sec")
"""Modules that each replica has from its first moment; not that which needs an extra."""


class MechanismRefused(HoldfastError, text="{name}: {problem}"):
    """The mechanism does not suit the actor, or cannot be had; the text says why."""

    name: str
    problem: str


@dataclasses.dataclass(frozen=True)
class Role:
    """The bricks of a replica in one role; a part that is left out passes everything through."""

    before: type[Before] | None = None
    proceed: type[Proceed] | None = None
    after: type[After] | None = None
    computes: bool = True
    """Whether the protected actor lives there; else its state is only kept, as bytes."""


class Code(msgspec.Struct, array_like=True, frozen=True):
    """A class by name, and the file if it came from one."""

    kind: str
    file: str = ""
    sha256: str = ""


class Description(msgspec.Struct, array_like=True, frozen=True):
    """A mechanism on its way to another process: its class by name, its settings, and the file if it came from one.

    `bricks` were exchanged for others at run time: role, part, class.
    """

    kind: str
    settings: dict[str, Any]
    file: str = ""
    sha256: str = ""
    bricks: tuple[tuple[str, str, Code], ...] = ()


@dataclasses.dataclass(frozen=True)
class Mechanism(MechanismDeclaration, Described):
    """Base of all mechanisms. Derive a frozen dataclass, and set the class attributes."""

    revived_by: ClassVar[str] = f"{__name__}:revive"
    """In the recipe of a subtree it travels as its description."""
    name: ClassVar[str] = ""
    replicas: ClassVar[int] = 1
    tolerates: ClassVar[frozenset[str]] = frozenset()
    """Of: crash, transient_value, permanent_value, development, eavesdropping, forgery, replay."""
    needs: ClassVar[frozenset[str]] = frozenset()
    """Of: state_access, determinism, assertions, versions, certificates."""
    keeps_members: ClassVar[bool] = False
    """Whether the next leader itself brings the others to its state, before anything leaves: they count all the while.

    Without it, all others have to join again after a failover, and until one has, nobody could take over.
    """
    bandwidth: ClassVar[str] = "low"
    cpu: ClassVar[str] = "low"
    units: ClassVar[int] = 1
    layer: ClassVar[str] = "replication"
    """Its place in a composition, outermost first: link, assertion, replication, repetition."""
    roles: ClassVar[dict[str, Role]] = {}
    """The first is that of the replica that leads, the second that of the others."""
    exchanged: ClassVar[dict[tuple[str, str], type[Brick]]] = {}
    """Bricks of this very instance that are others than its class says, by role and part (`with_brick`)."""

    detection: Detection | None = dataclasses.field(default=None, kw_only=True)
    """How its replicas are watched; None: as a mechanism inside says, or as usual."""

    def check(self, kind: type[Actor], where: str = "") -> None:
        """Refuse a class that the mechanism does not suit.

        Raises:
            MechanismRefused: naming what is missing.
        """
        who, name = where or type_name(kind), self.name or type_name(type(self))
        if "state_access" in self.needs and not kind.state_access:
            why = "saves and restores the state, and the class says state_access = False"
            raise MechanismRefused(name, f"{who}: it {why}")
        if "determinism" in self.needs and not kind.deterministic:
            raise MechanismRefused(name, f"{who}: it compares two runs, and the class says deterministic = False")

    def role(self, *, leads: bool) -> Role:
        """Return the bricks of a replica that leads, or of one that does not."""
        roles = list(self.roles.values()) or [Role()]
        role, name = roles[0] if leads else roles[-1], self.role_name(leads=leads)
        other: dict[str, Any] = {part: kind for (of, part), kind in self.exchanged.items() if of == name}
        return dataclasses.replace(role, **other) if other else role

    def role_name(self, *, leads: bool) -> str:
        """Return the name of the role of a replica that leads, or does not."""
        names = list(self.roles) or ["single"]
        return names[0] if leads else names[-1]

    @property
    def secures(self) -> bool:
        """Say whether the mechanism secures the links, and so stands around the protocol instead of behind it."""
        return type(self).open_link is not Mechanism.open_link

    def open_link(
        self,
        node: Node,
        address: str,
        path: str,
        epoch: Callable[[], int],
        enrols: Callable[[], list[str]] | None = None,
        distrusts: Callable[[str, str], None] | None = None,
    ) -> SecuredLink | None:
        """Open the end of the links that is at `path`, for a mechanism that secures them (`layer` "link").

        The root's end is told of whom it orders certificates (`enrols`), and tells of whom nothing can be believed any
        more, and why (`distrusts`).
        """
        return None

    def for_replicas(self) -> Self:
        """Return the mechanism with what only this process can add before replicas in others begin with it."""
        return self

    def with_brick(self, role: str, part: str, kind: type[Brick]) -> Self:
        """Return the same mechanism, with another brick as `before`, `proceed` or `after` of one role."""
        new = copy.copy(self)
        object.__setattr__(new, "exchanged", {**self.exchanged, (role, part): kind})
        return new

    def describe(self) -> Description:
        """Describe the mechanism for another process."""
        code = code_of(type(self))
        settings = {field.name: _plain(getattr(self, field.name)) for field in dataclasses.fields(self) if field.init}
        bricks = tuple((*key, code_of(kind)) for key, kind in sorted(self.exchanged.items(), key=lambda pair: pair[0]))
        return Description(code.kind, settings, code.file, code.sha256, bricks)


@dataclasses.dataclass(frozen=True)
class Unprotected(Mechanism):
    """One replica that does nothing else: on the way back from a mechanism to none."""

    name: ClassVar[str] = "unprotected"


NOTHING = (Unprotected(),)


def code_of(kind: type[Any]) -> Code:
    """How another process finds a class."""
    module = sys.modules.get(kind.__module__)
    file, digest = getattr(module, "__holdfast_file__", ("", ""))
    if not file and kind.__module__.startswith(SCRIPTS) and getattr(module, "__file__", None):
        file = str(getattr(module, "__file__", ""))
        digest = hashlib.sha256(Path(file).read_bytes()).hexdigest()
    return Code(message_name(kind), file, digest)


def find_class(code: Code) -> Any:
    """The class that is meant.

    Raises:
        MechanismRefused: its file is another one. What importing it raises.
    """
    if code.file:
        return operator.attrgetter(code.kind.partition(":")[2])(load_module(code.file, sha256=code.sha256))
    return imported(code.kind)


def _plain(value: Any) -> Any:
    """A setting as it travels; a mechanism that has structs among its settings takes them back as dicts."""
    return msgspec.to_builtins(value) if isinstance(value, msgspec.Struct | Detection) else value


def detection_in(layers: Iterable[Mechanism]) -> Detection | None:
    """How replicas are watched: as the outermost mechanism says that says anything about it."""
    return next((layer.detection for layer in layers if layer.detection is not None), None)


def compose(*layers: Mechanism | Iterable[Mechanism]) -> tuple[Mechanism, ...]:
    """Layers of mechanisms, outermost first: `compose(PBR(), TR())`.

    Raises:
        MechanismRefused: something in it is no mechanism.
    """
    flat: list[Mechanism] = []
    for one in layers:
        flat.extend([one] if isinstance(one, Mechanism) else one)
    for one in flat:
        if not isinstance(one, Mechanism):
            raise MechanismRefused("compose", f"takes mechanisms such as PBR(), not {one!r}")
        if not isinstance(one.detection, Detection | None):
            raise MechanismRefused(one.name, f"detection must be a Detection(...) or None, not {one.detection!r}")
    if not flat:
        raise MechanismRefused("compose", "takes at least one mechanism")
    return tuple(flat)


def revive(description: Description) -> Mechanism:
    """The mechanism that another process has described.

    Raises:
        MechanismRefused: it cannot be loaded, is another than there, or does not take these settings.
    """
    name = description.kind
    try:
        kind = find_class(Code(name, description.file, description.sha256))
        if not (isinstance(kind, type) and issubclass(kind, Mechanism)):  # Whatever it is, it is not called.
            raise MechanismRefused(name, "it is no Mechanism")
        settings, watched = description.settings, description.settings.get("detection")
        if isinstance(watched, dict):
            settings = {**settings, "detection": Detection(**watched)}
        made: Mechanism = kind(**settings)
    except MechanismRefused:
        raise
    except Exception as error:  # Importing runs the file: anything may be raised.
        raise MechanismRefused(name, f"it cannot be loaded: {type_name(type(error))}: {error}") from error
    for role, part, code in description.bricks:
        try:
            made = made.with_brick(role, part, find_class(code))
        except MechanismRefused:
            raise
        except Exception as error:  # The same.
            raise MechanismRefused(name, f"{code.kind} cannot be loaded: {error}") from error
    return made


def find(name: str) -> type[Mechanism]:
    """A mechanism's class by its name: a built-in one, or that of an entry point of the group `holdfast.mechanisms`.

    Raises:
        MechanismRefused: there is none of that name, or it cannot be loaded.
    """
    if name in BUILT_IN:
        return only(importlib.import_module(f"{BUILT_IN_PACKAGE}.{name}"), name)
    from importlib.metadata import entry_points  # It takes longer to import than all of this package.

    for point in entry_points(group=ENTRY_POINTS, name=name):
        try:
            kind = point.load()
        except Exception as error:  # It may be anything's code.
            raise MechanismRefused(name, f"its entry point {point.value} cannot be loaded: {error}") from error
        if isinstance(kind, type) and issubclass(kind, Mechanism):
            return kind
        raise MechanismRefused(name, f"its entry point {point.value} is no Mechanism")
    raise MechanismRefused(name, f"there is no mechanism of that name; built in: {', '.join(BUILT_IN)}")


def load(source: str | Path, *, sha256: str = "") -> type[Mechanism]:
    """The mechanism in a module (`package.module`) or a file that ends in `.py`.

    Args:
        source: what to load. A file must be ours, and nobody else may be able to write it.
        sha256: refuse a file that is another one.

    Raises:
        MechanismRefused: it cannot be loaded, or holds no mechanism, or several.
    """
    text = str(source)
    if not text.endswith(".py"):
        try:
            return only(importlib.import_module(text), text)
        except MechanismRefused:
            raise
        except Exception as error:
            raise MechanismRefused(text, f"it cannot be loaded: {type_name(type(error))}: {error}") from error
    return only(load_module(text, sha256=sha256), text)


def load_module(text: str, *, sha256: str = "") -> Any:
    """The module that a file makes.

    Raises:
        MechanismRefused: it cannot be loaded, is another one, or not safe from others.
    """
    path = Path(text).resolve()
    try:
        about = path.stat()
        code = path.read_bytes()
    except OSError as error:
        raise MechanismRefused(text, f"it cannot be read: {error}") from error
    if about.st_uid not in (os.getuid(), 0) or about.st_mode & 0o022:
        raise MechanismRefused(text, "the file must belong to this user, and nobody else may be able to write it")
    digest = hashlib.sha256(code).hexdigest()
    if sha256 and sha256 != digest:
        raise MechanismRefused(text, f"the file has changed: its SHA-256 is {digest}, not {sha256}")
    return _run(path, code, digest)


def _run(path: Path, code: bytes, digest: str) -> Any:
    """The module that this very code makes; loaded once."""
    place = hashlib.sha256(str(path).encode()).hexdigest()
    name = f"{FILES}{path.stem}_{place[:8]}_{digest[:16]}"
    module = sys.modules.get(name)
    if module is not None:
        return module
    spec = importlib.util.spec_from_loader(name, loader=None, origin=str(path))
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    module.__file__ = str(path)
    vars(module)["__holdfast_file__"] = (str(path), digest)
    sys.modules[name] = module
    try:
        exec(compile(code, str(path), "exec"), vars(module))
    except Exception as error:  # It runs whatever stands there.
        del sys.modules[name]
        raise MechanismRefused(str(path), f"it cannot be loaded: {type_name(type(error))}: {error}") from error
    return module


def only(module: Any, where: str) -> type[Mechanism]:
    """The one mechanism that a module defines.

    Raises:
        MechanismRefused: there is none, or more than one.
    """
    found = [
        value
        for value in vars(module).values()
        if isinstance(value, type) and issubclass(value, Mechanism) and value.__module__ == module.__name__
    ]
    if len(found) != 1:
        names = ", ".join(sorted(kind.__name__ for kind in found)) or "none"
        raise MechanismRefused(where, f"a mechanism's module defines one Mechanism, this one: {names}")
    return found[0]
