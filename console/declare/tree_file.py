"""A tree in a TOML file: a table for each actor, named by its address."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from typing import Any, Final, cast

from ...actors.backoff import Backoff
from ...actors.errors import HoldfastError, SpecError
from ...actors.kernel.actor import Actor, Start
from ...actors.kernel.mailbox import bounded
from ...actors.process.resource_limits import Limits
from ...actors.values import DamagedValue
from ...actors.values.classes import find_class
from ...checkpoint.recovery_file import METHODS, find_line
from ...ftm.model.mechanism import find
from ...supervision.dynamic import dynamic
from ...supervision.spec import ChildSpec, Flags, child
from ...supervision.tree import supervisor
from .wanted_tree import WantedActor

FLAGS: Final = ("strategy", "intensity", "period", "auto_shutdown", "max_children", "journal")
SUPERVISOR: Final = ("supervisor", *FLAGS[1:], "restart", "shutdown", "isolation", "limits", "significant")
ACTOR: Final = (
    "class",
    "args",
    "kwargs",
    "restart",
    "shutdown",
    "isolation",
    "recovery",
    "mailbox",
    "backoff",
    "limits",
    "bindings",
    "significant",
    "mechanism",
    "start_timeout",
    "running",
    "names",
)
NAMED_ANEW: Final = {"register": "names", "autostart": "running"}
"""What a child spec has under another name than a file."""
OF_ONE_SPEC: Final = ("name", "kind", "children", "strategy", "id", "start")
"""Keys at the top of a file for `hf.load_tree`."""
STRATEGIES: Final = ("one_for_one", "one_for_all", "rest_for_one")


class TreeFile:
    """What a file wants: every actor below an address, in the order in which they are started.

    Raises:
        SpecError: naming file, line and key, and what is wrong there.
    """

    def __init__(self, text: str, name: str) -> None:
        self._text, self._name = text, name
        try:
            tables = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:  # It says line and column.
            raise SpecError(name, str(error)) from error
        below = tables.pop("below", None)
        if below is not None and not (isinstance(below, str) and _is_address(below)):
            raise self.error("below", f'it must be an address such as "/app/bank", not {below!r}')
        self.actors: dict[str, WantedActor] = {}
        for path, table in tables.items():
            if path in OF_ONE_SPEC:
                problem = "this is one supervisor as hf.load_tree reads it, for system.start: here is"
                raise self.error(path, f'{problem} a table for each address, ["/app/bank"], of the whole tree')
            if not isinstance(table, dict) or not _is_address(path):
                raise self.error(path, 'there are `below = "/app"`, and tables named for an address: ["/app/bank"]')
            self.actors[path] = self._read(path, cast("dict[str, Any]", table))
        if not self.actors:
            raise SpecError(name, 'it names no actor: write a table for each, such as ["/app/bank"]')
        self.below = below or "/" + next(iter(self.actors)).split("/")[1]
        self._check()

    def error(self, path: str, problem: str, key: str | None = None) -> SpecError:
        """An error at a table, or at a key in it."""
        line = find_line(self._text, path, key) or self._line_of(path)
        where = f"{self._name}{f', line {line}' if line else ''}, {path}{f', {key}' if key else ''}"
        return SpecError(where, problem)

    def _line_of(self, key: str) -> int:
        """Where a key stands that is in no table; 0 if it is written in some other way."""
        lines = self._text.splitlines()
        return next((at for at, line in enumerate(lines, 1) if line.partition("=")[0].strip(" \"'") == key), 0)

    def _check(self) -> None:
        for path, one in self.actors.items():
            if path != self.below and not path.startswith(f"{self.below}/"):
                raise self.error(path, f"it is not below {self.below}, which this file is about")
            above = self.actors.get(one.above)
            if above is not None and (above.keeps_below or (above.spec is not None and not above.spec.is_supervisor)):
                raise self.error(path, f"{above.path} is no supervisor here, and has nobody below it")
            if above is None and path != self.below and one.above != self.below:
                raise self.error(path, f"its supervisor {one.above} has no table in this file")
        for one in self.actors.values():
            for port, target in one.bindings.items():
                if target.startswith(f"{self.below}/") and target not in self.actors and not self._is_kept(target):
                    raise self.error(one.path, f"{port} leads to {target}, which is not in this file", "bindings")

    def _is_kept(self, path: str) -> bool:
        """Whether somebody above is kept as it is, and may have this one below it."""
        return any(one.keeps_below and path.startswith(f"{one.path}/") for one in self.actors.values())

    # -- one table ----------------------------------------------------------------------------------------------------

    def _read(self, path: str, given: dict[str, Any]) -> WantedActor:
        if given.get("keep") is True and len(given) == 1:
            return WantedActor(path, None, keeps_below=True)
        if "keep" in given:
            raise self.error(path, "keep = true stands alone: the actor stays as it is", "keep")
        is_root = path.count("/") == 1
        is_supervisor = "supervisor" in given
        if is_supervisor is ("class" in given):
            raise self.error(path, 'it needs one of supervisor = "one_for_one" and class = "package.module:Class"')
        known = ("supervisor", "intensity", "period") if is_root else SUPERVISOR if is_supervisor else ACTOR
        for key in given:
            if key not in known:
                raise self.error(path, f"there is no key {key!r} here; there are {', '.join(known)}", key)
        if is_root:
            return WantedActor(path, None, flags=self._flags(path, given))
        try:
            spec = self._supervisor(path, given) if is_supervisor else self._actor(path, given)
        except (HoldfastError, TypeError, ValueError, DamagedValue) as error:
            problem = error.problem if isinstance(error, (SpecError, DamagedValue)) else str(error)
            if isinstance(error, SpecError) and error.where.startswith(self._name):
                raise
            for word, key in NAMED_ANEW.items():
                problem = key + problem.removeprefix(word) if problem.startswith(word) else problem
            raise self.error(path, problem, next((key for key in given if key in problem), None)) from error
        flags = spec.start.args[0] if is_supervisor else None
        return WantedActor(path, spec, flags=flags, names=tuple(self._texts(path, "names", given.get("names", []))))

    def _flags(self, path: str, given: dict[str, Any]) -> Flags:
        """The flags of the root: what is not said is as `ActorSystem` has it."""
        strategy = given["supervisor"]
        try:
            return Flags(strategy, given.get("intensity", 3), given.get("period", 5.0))
        except SpecError as error:
            raise self.error(path, error.problem, next((key for key in given if key in error.problem), None)) from error

    def _supervisor(self, path: str, given: dict[str, Any]) -> ChildSpec:
        options = {key: value for key, value in given.items() if key != "supervisor"}
        if "limits" in options:
            options["limits"] = self._made(path, "limits", Limits, options["limits"])
        name, kind = path.rpartition("/")[2], given["supervisor"]
        if kind == "dynamic":
            return dynamic(name, **options)
        if kind not in STRATEGIES:
            raise self.error(path, f"supervisor must be {', '.join(STRATEGIES)} or dynamic, not {kind!r}", "supervisor")
        return supervisor(name, strategy=kind, **options)

    def _actor(self, path: str, given: dict[str, Any]) -> ChildSpec:
        options: dict[str, Any] = {
            key: given[key]
            for key in ("restart", "shutdown", "isolation", "bindings", "significant", "start_timeout")
            if key in given
        }
        makers: dict[str, Callable[..., Any]] = {"mailbox": bounded, "backoff": Backoff, "limits": Limits}
        for key, make in makers.items():
            if key in given:
                options[key] = self._made(path, key, make, given[key])
        if "recovery" in given:
            options["recovery"] = self._recovery(path, given["recovery"])
        if "mechanism" in given:
            options["mechanism"] = self._mechanism(path, given["mechanism"])
        kind = find_class(self._text_of(path, "class", given["class"]))
        if not issubclass(kind, Actor):
            raise self.error(path, f"{given['class']} is no actor class", "class")
        args, kwargs = given.get("args", []), given.get("kwargs", {})
        if not isinstance(args, list):
            raise self.error(path, "args must be a list", "args")
        start: Start[Any] = Start(kind, tuple(args), dict(kwargs))
        register = next(iter(self._texts(path, "names", given.get("names", []))), None)  # Others are of its life.
        running = given.get("running", True)
        return child(path.rpartition("/")[2], start, autostart=running, register=register, **options)

    def _recovery(self, path: str, given: object) -> Any:
        settings = cast("dict[str, Any]", dict(given) if isinstance(given, dict) else {"method": given})
        method = settings.pop("method", "hybrid")
        if method not in METHODS:
            raise self.error(path, f"recovery must be one of {', '.join(METHODS)}, not {method!r}", "recovery")
        return self._made(path, "recovery", METHODS[method], settings)

    def _mechanism(self, path: str, given: object) -> Any:
        layers: list[Any] = []
        for one in given if isinstance(given, list) else [given]:
            settings = dict(one) if isinstance(one, dict) else {"name": one}
            kind = find(self._text_of(path, "mechanism", settings.pop("name", None)).lower())
            layers.append(self._made(path, "mechanism", kind, settings))
        return layers[0] if len(layers) == 1 else tuple(layers)

    def _made(self, path: str, key: str, make: Callable[..., Any], settings: object) -> Any:
        if not isinstance(settings, dict):
            raise self.error(path, f"{key} must be a table of settings, not {settings!r}", key)
        try:
            return make(**settings)
        except (HoldfastError, TypeError, ValueError) as error:
            raise self.error(path, f"{key}: {error}", key) from error

    def _text_of(self, path: str, key: str, value: object) -> str:
        if not isinstance(value, str):
            raise self.error(path, f"{key} must be text, not {value!r}", key)
        return value

    def _texts(self, path: str, key: str, value: object) -> list[str]:
        if not isinstance(value, list) or not all(isinstance(one, str) for one in value):
            raise self.error(path, f"{key} must be a list of texts, not {value!r}", key)
        if len(set(value)) < len(value):
            raise self.error(path, f"{key} must have each text once, not {value!r}", key)
        return cast("list[str]", value)


def _is_address(path: str) -> bool:
    return path.startswith("/") and not path.endswith("/")
