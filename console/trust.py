"""What a running system imports for a request: only from files that nobody else could have written, each one told."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import os
import sys
from collections.abc import Generator, Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType

from ..actors.errors import SpecError
from ..actors.node import Node
from ..system.script import UntrustedFile, check_folders, check_owner, load_source, read_source, tell_loaded
from .wire import AnyArg, Packed


@dataclasses.dataclass(frozen=True, slots=True)
class Needed:
    """What a request may need to be loaded: the script it comes from (path and sha256), and what is packed in it."""

    script: tuple[str, str] | None
    args: list[AnyArg]

    def is_used(self, module: str) -> bool:
        """Whether something in it is of this module."""
        name = module.encode()
        return any(isinstance(arg, Packed) and name in arg.data for arg in self.args)


@contextlib.contextmanager
def trusted_imports(node: Node, needed: Needed) -> Generator[None, None, None]:
    """While the block runs, modules are imported only from files of this user, or root's, that nobody else may write.

    The script's own module is loaded first, if something in the request is defined there.

    Raises:
        UntrustedFile: the script could have been written by somebody else. SpecError: it is not what was sent.
    """
    if needed.script is not None:
        path, sha256 = needed.script
        source = read_source(path)
        if source.sha256 != sha256:
            raise SpecError(path, "it has changed since the command has read it: start it again")
        if needed.is_used(source.module) and source.module not in sys.modules:
            load_source(source)
        tell_loaded(node, source.path, sha256)
    guard = _Guard(node)
    sys.meta_path.insert(0, guard)
    try:
        yield
    finally:
        sys.meta_path.remove(guard)


class _Guard:
    """Stands before all other finders, and looks at what they find."""

    def __init__(self, node: Node) -> None:
        self._node = node

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
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
        try:
            check_owner(str(full), os.stat(full), {owner, 0})
            check_folders(full.parent, {owner, 0})
            tell_loaded(self._node, str(full), hashlib.sha256(full.read_bytes()).hexdigest())
        except OSError as error:
            raise UntrustedFile(origin, error.strerror or str(error)) from error
