"""Programs that follow each other on one store: each is given as text, and leaves the store as a kill would."""

from __future__ import annotations

import contextlib
import importlib
import sys
from collections.abc import AsyncGenerator, Generator
from pathlib import Path
from typing import Any

import holdfast as hf

NAME = "upgraded"
"""The module that each program is loaded as."""
LONG = 25.0
"""Seconds that an ask may take on a busy machine."""

HEAD = """
import dataclasses
from typing import Any

import holdfast as hf
import msgspec


class Get(hf.Message[list[Any]]): ...


def plain(value):
    if isinstance(value, msgspec.Struct):
        return {name: plain(getattr(value, name)) for name in value.__struct_fields__}
    if isinstance(value, dict):
        return {key: plain(one) for key, one in value.items()}
    return [plain(one) for one in value] if isinstance(value, (list, tuple)) else value
"""


@contextlib.contextmanager
def program(text: str, folder: Path) -> Generator[Any]:
    """Load the text of a program as the module that all of them have been; processes find it in this folder."""
    folder.mkdir()
    (folder / f"{NAME}.py").write_text(HEAD + text)
    importlib.invalidate_caches()
    sys.modules.pop(NAME, None)
    sys.path.insert(0, str(folder))
    try:
        yield importlib.import_module(NAME)
    finally:
        sys.path.remove(str(folder))


class Generations:
    """A store, and the programs that are run on it one after the other."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._number, self._programs = folder, 0, 0
        self.events: list[Any] = []

    @property
    def store(self) -> Path:
        """The store as the last program has left it."""
        return self._folder / f"{self._number}.db"

    @contextlib.asynccontextmanager
    async def run(
        self, text: str, *, method: Any = hf.hybrid, isolation: Any = "task", mechanism: Any = None, **recovery: Any
    ) -> AsyncGenerator[tuple[Any, Any, Any]]:
        """Run a program; its store is that which is there at the end of the block, as if it had been killed then."""
        how = hf.replay_only() if method is hf.replay_only else hf.hybrid(interval=1000.0, **recovery)
        after = self._folder / f"{self._number + 1}.db"
        self._programs += 1
        with program(text, self._folder / f"code{self._programs}") as module:
            async with hf.ActorSystem("app", store=f"sqlite:{self.store}", log=False) as system:
                system._node.events.add_sink(self.events.append)
                for name, kind in getattr(module, "OTHERS", {}).items():
                    await system.start(hf.child(name, hf.start(kind)))
                actor = await system.start(
                    hf.child("a", hf.start(module.A), recovery=how, isolation=isolation, mechanism=mechanism)
                )
                yield system, actor, module
                await system.backup(after)
        self._number += 1

    def told(self, kind: type[Any]) -> list[Any]:
        """The events of this kind so far; they are forgotten."""
        found = [event for event in self.events if isinstance(event, kind)]
        self.events.clear()
        return found
