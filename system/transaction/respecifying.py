"""The operation that changes what a child's spec says of restarts and stops."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

from ...actors.errors import NoSuchActor
from ...supervision.respec import replace_options
from ...supervision.spec import check_spec
from .draft import Draft, Target, is_elsewhere
from .operation import Operation, wrong

if TYPE_CHECKING:
    from ..system import ActorSystem

OPTIONS = ("restart", "shutdown", "backoff", "significant", "start_timeout", "rules")
"""What a supervisor looks up at each restart or stop, so that it can be another at any time."""


class Respecify(Operation):
    """Have a supervisor restart and stop one of its children by other options, from now on."""

    verb: ClassVar[str] = "respecify"

    def __init__(self, target: Target, options: dict[str, Any]) -> None:
        super().__init__(target)
        self._options = options

    @property
    def text(self) -> str:
        return f"set {', '.join(f'{name}={value!r}' for name, value in self._options.items())} of {self.target}"

    async def check(self, system: ActorSystem, draft: Draft) -> None:
        place = self._found = draft.find(self._at)
        self.target = place.path
        above = place.parent
        unknown = next((name for name in self._options if name not in OPTIONS), None)
        if unknown is not None:
            raise wrong(place.path, f"{unknown} of a child that runs cannot be another: {', '.join(OPTIONS)} can")
        if above is None or place.spec is None:
            raise wrong(place.path, "no supervisor of this process looks after it")
        if place.is_planned or above.cell is None or is_elsewhere(above.cell):
            raise wrong(place.path, "its supervisor lives in another process, or is added by this very transaction")
        place.spec = dataclasses.replace(place.spec, **self._options)
        check_spec(above.path, place.spec, above.flags.auto_shutdown if above.flags is not None else None)

    def ready(self, system: ActorSystem) -> str:
        if self._place.cell is None:
            raise NoSuchActor(self.target)
        return ""

    def commit(self, system: ActorSystem) -> None:
        cell = self._place.now(system._node) or self._place.cell
        assert cell is not None
        replace_options(cell, self._options)
