"""Code that is loaded at run time: taken only from a file that nobody else could have written."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import inspect
import os
import stat
import sys
import types
from collections.abc import Awaitable, Callable, Generator, Sequence
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import Any

from ..actors.errors import HoldfastError, SpecError, error_text, type_name
from ..actors.kernel.node import Node
from .transaction.events import ScriptLoaded

PREFIX = "holdfast_script_"
"""How the modules of scripts are called; the rest is the beginning of their sha256."""
LARGEST = 4 * 1024 * 1024
"""Bytes a script may have."""
_BROUGHT: list[str] = []
"""Entries of `sys.path` that scripts have brought, these very strings: the next program does not have them."""


class UntrustedFile(HoldfastError, text="{path} is not used: {problem}"):
    """A file, or a folder above it, could have been written by somebody else: it is not used."""

    path: str
    problem: str


@dataclasses.dataclass(frozen=True, slots=True)
class ScriptSource:
    """A script as it was read: what is checked, hashed and run are the same bytes."""

    path: str
    data: bytes

    @property
    def sha256(self) -> str:
        """Of the bytes, in hex digits."""
        return hashlib.sha256(self.data).hexdigest()

    @property
    def module(self) -> str:
        """The name of its module: the same in every process that has loaded these bytes."""
        return PREFIX + self.sha256[:16]


@dataclasses.dataclass(frozen=True, slots=True)
class Script:
    """A script that is loaded."""

    source: ScriptSource
    reconfigure: Callable[[Any], Awaitable[Any]]


def read_source(path: str | os.PathLike[str], uid: int | None = None) -> ScriptSource:
    """Read a file, if only this user could have written it.

    Args:
        path: of the file.
        uid: the user; the one this process runs as if left out.

    Raises:
        UntrustedFile: it belongs to somebody else, or others may write it, or a folder above it.
        SpecError: it cannot be read, or is no file, or too large.
    """
    owner = os.geteuid() if uid is None else uid
    full = Path(os.path.realpath(path))
    try:
        with open(full, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NOFOLLOW | os.O_NONBLOCK)) as file:
            info = os.fstat(file.fileno())
            if not stat.S_ISREG(info.st_mode):
                raise SpecError(str(full), "this is no file")
            check_owner(str(full), info, {owner})
            check_folders(full.parent, {owner})
            data = file.read(LARGEST + 1)
    except OSError as error:
        raise SpecError(str(path), error.strerror or str(error)) from error
    if len(data) > LARGEST:
        raise SpecError(str(full), f"a script has at most {LARGEST} bytes")
    return ScriptSource(str(full), data)


def check_owner(path: str, info: os.stat_result, owners: set[int]) -> None:
    """Whether a file or folder belongs to one of these users, and nobody else may write it.

    Raises:
        UntrustedFile: it does not, or somebody may.
    """
    if info.st_uid not in owners:
        raise UntrustedFile(path, f"it belongs to the user with uid {info.st_uid}, not to you")
    if info.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise UntrustedFile(path, f"others may write it (mode {stat.S_IMODE(info.st_mode):04o}); chmod go-w")


def check_folders(folder: Path, owners: set[int], *, may_share: bool = False) -> None:
    """Whether nobody else could put another file in the place of one in this folder.

    The folder itself must belong to one of the owners; those above may be root's, and open to all if they keep
    everybody's files apart (the sticky bit, as /tmp has it). `may_share`: the folder itself too.

    Raises:
        UntrustedFile: somebody could.
    """
    for number, one in enumerate((folder, *folder.parents)):
        above = bool(number) or may_share
        info = os.stat(one)
        allowed = owners | {0} if above else owners
        if above and info.st_mode & stat.S_ISVTX and info.st_uid in allowed:
            continue
        check_owner(str(one), info, allowed)


def find_beside(source: ScriptSource) -> None:
    """Let modules be found in the folder of a script too, after all others, so that it can hide none of them."""
    folder = str(Path(source.path).parent)
    if folder not in sys.path:
        sys.path.append(folder)
        _BROUGHT.append(folder)


def find_only_here(kind: type) -> str:
    """The file that defines a class which only processes with a script can have: the script, or a module beside it.

    Returns:
        Its path; "" if the class can be imported without any script.
    """
    package = kind.__module__.partition(".")[0]
    file, origin = _file_of(kind.__module__), _file_of(package)
    if kind.__module__.startswith(PREFIX):
        return file or kind.__module__
    brought = [entry for entry in sys.path if any(entry is one for one in _BROUGHT)]
    if not any(Path(origin).is_relative_to(folder) for folder in brought):
        return ""
    rest = [entry for entry in sys.path if not any(entry is one for one in brought)]
    return "" if PathFinder.find_spec(package, rest) is not None else file


def _file_of(module: str) -> str:
    """The file that a module was imported from; "" if it has none."""
    found = sys.modules.get(module)
    return "" if found is None else str(vars(found).get("__file__") or "")


@contextlib.contextmanager
def guarded_imports(tell: Callable[[str, str], None], beside: tuple[str, ...] = ()) -> Generator[None, None, None]:
    """While the block runs, modules are imported only from files of this user, or root's, that nobody else may write.

    Args:
        tell: is told path and sha256 of each, when the block is over.
        beside: folders that are not looked into, such as those of the interpreter itself.

    Raises (in the import):
        UntrustedFile: somebody else could have written it.
    """
    guard = _Guard(beside)
    sys.meta_path.insert(0, guard)
    try:
        yield
    finally:
        sys.meta_path.remove(guard)
        for path, sha256 in guard.found:  # Not before: whoever is told may need a module that is half imported.
            tell(path, sha256)


class _Guard:
    """Stands before all other finders, and looks at what they find."""

    def __init__(self, beside: tuple[str, ...]) -> None:
        self._beside = beside
        self.found: list[tuple[str, str]] = []  # path and sha256 of each module

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: types.ModuleType | None = None
    ) -> ModuleSpec | None:
        """The module's spec as the others find it. Raises UntrustedFile."""
        for finder in sys.meta_path:
            found = None if finder is self else finder.find_spec(name, path, target)
            if found is not None:
                if found.has_location and found.origin is not None:
                    self._look(found.origin)
                return found
        return None

    def _look(self, origin: str) -> None:
        full, owner = Path(os.path.realpath(origin)), os.geteuid()
        if any(full.is_relative_to(one) for one in self._beside):
            return
        try:
            check_owner(str(full), os.stat(full), {owner, 0})
            check_folders(full.parent, {owner, 0})
            self.found.append((str(full), hashlib.sha256(full.read_bytes()).hexdigest()))
        except OSError as error:
            raise UntrustedFile(origin, error.strerror or str(error)) from error


def _tell_nobody(path: str, sha256: str) -> None:
    """Who runs a script from the command line sees what it does."""


def load_source(source: ScriptSource) -> types.ModuleType:
    """Run the source as a module, once in a process. What it imports may lie beside it.

    Raises:
        SpecError: it raised. UntrustedFile: it imports a file that somebody else could have written.
    """
    known = sys.modules.get(source.module)
    if known is not None:
        return known
    find_beside(source)
    module = types.ModuleType(source.module)
    module.__file__ = source.path
    sys.modules[source.module] = module  # Before it runs: its classes are looked up by this name.
    try:
        with guarded_imports(_tell_nobody, (sys.prefix, sys.base_prefix)):
            exec(compile(source.data, source.path, "exec"), module.__dict__)
    except BaseException as error:
        del sys.modules[source.module]
        if not isinstance(error, Exception) or isinstance(error, UntrustedFile):
            raise
        raise SpecError(source.path, f"{type_name(type(error))}: {error_text(error)}") from error
    return module


def load_script(path: str | os.PathLike[str], node: Node | None = None) -> Script:
    """Load a reconfiguration script; `node` tells of it as an event.

    Raises:
        UntrustedFile: somebody else could have written it.
        SpecError: it cannot be read, raises, or has no `async def reconfigure(system)`.
    """
    source = read_source(path)
    if node is not None:
        tell_loaded(node, source.path, source.sha256)
    reconfigure = getattr(load_source(source), "reconfigure", None)
    if not inspect.iscoroutinefunction(reconfigure):
        raise SpecError(source.path, "it has no `async def reconfigure(system)`")
    return Script(source, reconfigure)


def tell_loaded(node: Node, path: str, sha256: str) -> None:
    """Say that this code is loaded."""
    root = node.root
    if node.events.has_listeners and root is not None:
        node.emit(ScriptLoaded(root.path, path, sha256))
