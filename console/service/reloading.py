"""Modules are imported again when their files have changed, all of them or none."""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import sys
import sysconfig
from collections.abc import Generator
from pathlib import Path
from types import FunctionType, ModuleType

from ...actors.errors import HoldfastError, SpecError, error_text, type_name
from ...actors.kernel.message import Message

OTHERS = tuple({sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")})
"""Where modules of other people are; they are not looked at."""


class ProjectModules:
    """The modules of the program itself, and what was in their files when they were imported.

    Args:
        target: the module that was named; those in its package, or beside it, belong to the program.
    """

    def __init__(self, target: str) -> None:
        found = sys.modules[target]
        self._top = target.partition(".")[0]
        self._folder = Path(found.__file__ or "").parent if "." not in target else None
        self._hashes = {name: _hash(module) for name, module in self._modules().items()}

    def _modules(self) -> dict[str, ModuleType]:
        """Those of the program, in the order in which they were imported: what a module imports comes before it."""
        return {name: module for name, module in list(sys.modules.items()) if self._is_ours(name, module)}

    def _is_ours(self, name: str, module: ModuleType) -> bool:
        file = module.__dict__.get("__file__")
        if not isinstance(file, str) or not file.endswith(".py") or name == "__main__":
            return False
        if name.partition(".")[0] == self._top:
            return True
        is_others = any(Path(file).is_relative_to(folder) for folder in OTHERS)
        return self._folder is not None and not is_others and Path(file).parent == self._folder

    def changed(self) -> list[str]:
        """The names of modules whose files are others than when they were imported."""
        return [name for name, module in self._modules().items() if _hash(module) != self._hashes.get(name)]

    @contextlib.contextmanager
    def imported_again(self) -> Generator[set[str], None, None]:
        """Import again what has changed, and what uses it; the names are given. If the block raises, all is as before.

        Raises:
            SpecError: one raises, or defines messages, which may wait in mailboxes as those of the old module.
        """
        modules = self._modules()
        names = _with_users(set(self.changed()), modules)
        for name in sorted(names):
            messages = [
                one for one in vars(modules[name]).values() if isinstance(one, type) and issubclass(one, Message)
            ]
            if any(one.__module__ == name for one in messages):
                why = "some may wait, and would be of the old classes; put messages into a module of their own"
                raise SpecError(name, f"it defines messages, and is not reloaded while the program runs: {why}")
        before = {name: dict(vars(modules[name])) for name in names}
        try:
            for name in [name for name in modules if name in names]:
                try:
                    importlib.reload(modules[name])
                except HoldfastError:
                    raise
                except BaseException as error:  # A module may raise anything, SystemExit too: the program goes on.
                    raise SpecError(name, f"it raised {type_name(type(error))}: {error_text(error)}") from error
            yield names
        except BaseException:
            for name, kept in before.items():
                vars(modules[name]).clear()
                vars(modules[name]).update(kept)
            raise
        self._hashes = {name: _hash(module) for name, module in self._modules().items()}


def _hash(module: ModuleType) -> str:
    try:
        return hashlib.sha256(Path(str(module.__file__)).read_bytes()).hexdigest()
    except OSError:  # It is gone: whoever imports it again says so.
        return ""


def _with_users(names: set[str], modules: dict[str, ModuleType]) -> set[str]:
    """These modules, and all that have something of one of them, or of one that has."""
    found = set(names)
    while True:
        more = {
            name
            for name, module in modules.items()
            if name not in found and any(_origin(one) in found for one in list(vars(module).values()))
        }
        if not more:
            return found
        found |= more


def _origin(value: object) -> str:
    """The module that a value is, or in which it was defined; empty if that is not known."""
    if isinstance(value, ModuleType):
        return value.__name__
    return (value if isinstance(value, type | FunctionType) else type(value)).__module__
