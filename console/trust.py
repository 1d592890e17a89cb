"""Imports code for a request only from files that nobody else could have written, and reports each import."""

from __future__ import annotations

import contextlib
import dataclasses
import sys
from collections.abc import Generator

from ..actors.errors import SpecError
from ..actors.kernel.node import Node
from ..system.script import find_beside, guarded_imports, load_source, read_source, tell_loaded
from .wire import AnyArg, PackedArg


@dataclasses.dataclass(frozen=True, slots=True)
class Needed:
    """What a request may need to be loaded: the script it comes from (path and sha256), and what is packed in it."""

    script: tuple[str, str] | None
    args: list[AnyArg]

    def is_used(self, module: str) -> bool:
        """Whether something in it is of this module."""
        name = module.encode()
        return any(isinstance(arg, PackedArg) and name in arg.data for arg in self.args)


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
        find_beside(source)
        if needed.is_used(source.module) and source.module not in sys.modules:
            load_source(source)
        tell_loaded(node, source.path, sha256)
    with guarded_imports(lambda path, sha256: tell_loaded(node, path, sha256)):
        yield
