"""Where the time of a request goes: when each brick is handed it, in all processes, on one clock."""

from __future__ import annotations

import json
import os
import statistics
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

from holdfast.actors.kernel.actor import Actor, Start
from holdfast.ftm.bricks.bricks import Brick
from holdfast.ftm.group.proxy import Proxy
from holdfast.ftm.model.mechanism import BUILT_IN, find
from holdfast.ftm.replica.replica import Replica
from holdfast.ftm.replica.state_manager import StateManager

KEPT = 400  # marks between two writes

Mark = tuple[float, str]


class Marks:
    """The moments at which bricks of this process were handed something; now and then they go to a file."""

    def __init__(self, file: Path | None = None) -> None:
        self.seen: list[Mark] = []
        self.file = file

    def wrap(self, kind: type[Actor], name: str) -> None:
        """Note each message that actors of this class handle."""
        table: Any = kind._table
        for message in kind._declared:
            handler = table[message]
            if not hasattr(handler, "__marked__"):
                table[message] = self._marked(handler, name, message.__name__)

    def _marked(self, handler: Any, name: str, message: str) -> Any:
        seen, clock = self.seen, time.perf_counter

        def marked(actor: Any, item: Any) -> Any:
            seen.append((clock(), f"{name or actor.slot}:{message}"))
            if len(seen) >= KEPT and self.file is not None:
                with self.file.open("a") as file:
                    file.write(json.dumps(seen) + "\n")
                seen.clear()
            return handler(actor, item)

        marked.__marked__ = True  # type: ignore[attr-defined]
        return marked


ROOT = Marks()


class TimedReplica(Replica):
    """A replica whose bricks note when they are handed something."""

    def __init__(self, setting: Any, start: Start[Any], layers: Any, folder: str) -> None:
        super().__init__(setting, start, layers)
        marks = Marks(Path(folder) / f"{setting.name}.{os.getpid()}")
        for name in BUILT_IN:
            find(name)
        for kind in {*_derived(Brick), StateManager}:
            marks.wrap(kind, "state" if kind is StateManager else "")
        marks.wrap(start.kind, "server")


def _derived(kind: type[Any]) -> list[type[Any]]:
    direct: list[type[Any]] = kind.__subclasses__()
    return [one for each in direct for one in (each, *_derived(each))]


def recipe(folder: Path) -> Any:
    """What stands in for `holdfast.ftm.group.group_place.replica`."""

    def replica(setting: Any, start: Start[Any], layers: tuple[Any, ...]) -> Start[Any]:
        return Start(TimedReplica, (setting, start, layers, str(folder)))

    return replica


def root_marks() -> Marks:
    """Of the proxy, in this process."""
    ROOT.seen.clear()
    ROOT.wrap(Proxy, "proxy")
    return ROOT


def by_brick(asks: list[tuple[float, float]], marks: list[Mark]) -> list[tuple[str, float]]:
    """Median seconds from the step before to each step, in the order in which they mostly come."""
    marks = sorted(marks)
    spans, places = defaultdict[str, list[float]](list), defaultdict[str, list[int]](list)
    at = 0
    for begin, end in asks:
        while at < len(marks) and marks[at][0] < begin:
            at += 1
        before, place = begin, 0
        while at < len(marks) and marks[at][0] <= end:
            moment, name = marks[at]
            spans[name].append(moment - before)
            places[name].append(place)
            before, at, place = moment, at + 1, place + 1
        spans["reply"].append(end - before)
        places["reply"].append(1000)
    often = [name for name in spans if len(spans[name]) > len(asks) / 2]
    often.sort(key=lambda name: statistics.median(places[name]))
    return [(name, statistics.median(spans[name])) for name in often]
