"""Answers to questions about a supervisor's children, which change nothing."""

from __future__ import annotations

import dataclasses
from collections import Counter
from typing import Any

from ..actors.errors import HoldfastError
from ..actors.kernel.actor import Actor, on
from ..actors.kernel.envelope import ReplyHandle, refuse
from .admin import (
    Boxed,
    ChildCounts,
    ChildInfo,
    CountChildren,
    EndedChild,
    EndedChildren,
    GetChildSpec,
    NoSuchChild,
    WhichChildren,
)
from .children import Child
from .intensity import recent_restarts
from .spec import Flags


class Inquiries(Actor):
    """Base of supervisors: they have children, and answer what is asked about them."""

    _children: dict[str, Child]
    _flags: Flags
    _restarts: tuple[float, ...]
    _ended: dict[str, object]  # why each child has ended that has not been started since

    def _overview(self) -> dict[str, Any]:
        """Flags, restarts within the period, and children; nothing before our start has come so far."""
        if "_children" not in self.__dict__:
            return {}
        recent = recent_restarts(self._restarts, self.ctx._cell.node.loop.time(), self._flags.period)
        children = {one.spec.id: one.overview() for one in self._children.values()}
        return {**dataclasses.asdict(self._flags), "restarts": len(recent), "children": children}

    @on(WhichChildren, readonly=True)
    def _which_children(self, message: WhichChildren) -> list[ChildInfo]:
        """What there is, in start order."""
        return [one.info(self.ctx.path) for one in self._children.values()]

    @on(EndedChildren, readonly=True)
    def _ended_children(self, message: EndedChildren) -> list[EndedChild]:
        """Who has ended, the last one last."""
        path, has_recorded = self.ctx.path, self.ctx._cell.node.ports.keeper.has_recorded
        return [
            EndedChild(name, f"{path}/{name}", str(why), has_recorded(f"{path}/{name}"))
            for name, why in self._ended.items()
        ]

    @on(CountChildren, readonly=True)
    def _count_children(self, message: CountChildren) -> ChildCounts:
        """Count the children: all, those that run, supervisors and workers, and those that wait for somebody."""
        children = self._children.values()
        supervisors = sum(one.spec.is_supervisor for one in children)
        active = sum(one.is_running for one in children)
        awaited = Counter(one.awaited for one in children if one.awaited)
        return ChildCounts(len(children), active, supervisors, len(children) - supervisors, dict(awaited))

    @on(GetChildSpec, readonly=True)
    def _get_child_spec(self, message: GetChildSpec) -> Any:
        """Find the spec of one child."""
        spec = self._child(message.id).spec
        return spec if self.ctx._cell.node.ports.uplink is None else Boxed(spec)

    def _child(self, name: str) -> Child:
        one = self._children.get(name)
        if one is None:
            raise NoSuchChild(name)
        return one

    def _fail(self, error: HoldfastError) -> ReplyHandle[Any]:
        """Answer an admin call with an error: it is the caller's business, not our crash."""
        return refuse(self.ctx, error)
