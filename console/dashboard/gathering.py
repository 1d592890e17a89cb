"""One gathering for all viewers: while somebody looks at the page it looks at the system, and tells what changes."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Collection
from typing import Any, Final

import msgspec

from ...actors.errors import HoldfastError, SpecError
from ...system.history.evidence import PutAside
from ...system.history.pages import HistoryPage, question
from ...system.history.past_event import PastEvent
from ..overview import LOOK, SystemLook
from ..wire import AskCauses, AskDiagnosis, AskHistory, AskQuarantined, NotDiagnosed, Overview
from .answers import Answers
from .picture import Picture, plain
from .troubles import NEWS, TELLING, SeenSystem, Trouble, diagnosed_troubles, grade_of, seen_causes, suspects, troubles

SHARE: Final = 0.01
"""The part of one processor that looks at what is on the screens may take, unless they became rarer than a second."""
SHARE_OF_ALL: Final = 0.005
"""The same of looks at all actors, and of asking why, unless they became rarer than `RAREST`."""
QUICKEST: Final = 0.1
"""Seconds between two looks at least."""
RAREST: Final = 5.0
"""Seconds between two looks at all actors at most."""
RAREST_SOME: Final = 1.0
"""Seconds between two looks at the actors that are on somebody's screen at most."""
SUSPECTING: Final = 0.5
"""Seconds after which it is looked again whether somebody looks ill."""
TOGETHER: Final = 0.2
"""Seconds between two rounds of asking why at least."""
SETTLED: Final = 0.4
"""Seconds after which actors of whom something was told are looked at again: an end may be told before it is over."""
CHANGING: Final = ("TransactionCommitted", "TransactionRolledBack", "SystemStarted")
"""Events after which all actors are looked at: any of them may be elsewhere, or be another one."""
MOST_AT_ONCE: Final = 500
"""Actors of a look at some: if more have changed, all are looked at."""
MOST_WATCHED: Final = 200
"""Rows on one viewer's screen."""
SILENT: Final = 3.0
"""Seconds after which the viewers are told that the system does not answer."""
ANSWER: Final = 10.0
"""Seconds that the system has for an answer; then it is told that it does not answer, and asked again."""
AGAIN: Final = 1.0
"""Seconds until a system is asked again that did not answer."""
ONE_WAIT: Final = 20.0
"""Seconds for which one request waits for the next event."""
KEPT: Final = 200
"""Events that a new viewer is shown."""
MOST_PENDING: Final = 64
"""What a viewer may be behind; one that has not read so much is dropped."""
MOST_VIEWERS: Final = 50
"""Viewers at a time."""
MOST_OF_ONE: Final = 16
"""Viewers at a time of one login."""
BEAT: Final = 10.0
"""Seconds after which something is sent to a viewer if nothing has changed, so that it is seen when it has gone."""


class TooManyViewers(HoldfastError, text="{count} viewers look at the system already: close a page, and try again"):
    """The dashboard serves so many live views at a time, and no more."""

    count: int


class Viewer:
    """What one open page has not been sent yet; who does not read it is dropped, and never waited for."""

    def __init__(self, number: int, login: str) -> None:
        self.number, self.login = number, login
        self.watched: frozenset[str] = frozenset()
        """The addresses on its screen."""
        self._pending: deque[bytes] = deque()
        self._has_news = asyncio.Event()
        self.gone = asyncio.Event()
        """Set when it was dropped, or the dashboard has closed."""

    def put(self, message: bytes) -> None:
        """Have it sent, unless it is too far behind: then it is dropped."""
        if len(self._pending) >= MOST_PENDING:
            self.drop()
            return
        self._pending.append(message)
        self._has_news.set()

    def drop(self) -> None:
        """Send it nothing any more."""
        self._pending.clear()
        self.gone.set()
        self._has_news.set()

    async def next(self) -> bytes:
        """All that is to be sent, or a beat if there was nothing for a while; empty when it was dropped."""
        try:
            async with asyncio.timeout(BEAT):
                await self._has_news.wait()
        except TimeoutError:
            return b": still here\n\n"
        self._has_news.clear()
        sent = b"".join(self._pending)
        self._pending.clear()
        return sent


class Gathering:
    """Looks at a system for as long as there are viewers.

    Args:
        answers: who answers.
    """

    def __init__(self, answers: Answers) -> None:
        self._answers = answers
        self._viewers: dict[int, Viewer] = {}
        self._next_number = 1
        self._tasks: list[asyncio.Task[None]] = []
        self._forget()

    def _forget(self) -> None:
        """Nobody looks: begin with nothing, next time."""
        self.picture = Picture()
        self._troubles: list[Trouble] = []
        self._diagnosed: list[Trouble] = []
        self._problem = ""
        self._events: deque[PastEvent] = deque(maxlen=KEPT)
        self._told: dict[str, float] = {}
        self._put_aside: list[PutAside] = []
        self._is_seen = False
        self._is_judged = False
        """Whether those who look ill were asked: before that nobody can say that all is well."""
        self._hurried: set[str] = set()
        self._later: set[str] = set()
        self._has_changed = False
        self._hurry, self._suspect = asyncio.Event(), asyncio.Event()

    # -- viewers ------------------------------------------------------------------------------------------------------

    def add(self, login: str) -> Viewer:
        """One more viewer; the first one has the gathering begin.

        Args:
            login: who looks: one login takes no more than a few of all views.

        Raises:
            TooManyViewers: there is none left, for this login or at all.
        """
        own = sum(one.login == login for one in self._viewers.values())
        if own >= MOST_OF_ONE or len(self._viewers) >= MOST_VIEWERS:
            raise TooManyViewers(own if own >= MOST_OF_ONE else len(self._viewers))
        viewer = Viewer(self._next_number, login)
        self._next_number += 1
        self._viewers[viewer.number] = viewer
        if not self._tasks:
            self._forget()
            work = (self._look_on, self._follow, self._ask_why, self._ask_diagnosis)
            self._tasks = [asyncio.create_task(self._again(one), name="holdfast dashboard") for one in work]
        elif self._is_seen or self._problem:
            viewer.put(self._snapshot(viewer))
        return viewer

    async def remove(self, viewer: Viewer) -> None:
        """A viewer has gone; with the last one the gathering ends."""
        self._viewers.pop(viewer.number, None)
        if not self._viewers:
            await self._end()

    async def close(self) -> None:
        """Drop all viewers, and end."""
        for viewer in list(self._viewers.values()):
            viewer.drop()
        self._viewers.clear()
        await self._end()
        await self._answers.close()

    async def _end(self) -> None:
        tasks, self._tasks = self._tasks, []
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)
        if not self._tasks:  # Nobody has come meanwhile.
            self._forget()

    def watch(self, number: int, paths: Collection[str]) -> None:
        """Say what is on a viewer's screen: that is looked at more often, if it cannot be all."""
        viewer = self._viewers.get(number)
        if viewer is not None:
            viewer.watched = frozenset(path for path in list(paths)[:MOST_WATCHED] if path in self.picture.rows)
            self._hurry.set()

    def hurry(self, paths: Collection[str]) -> None:
        """Something was done to these actors: look at them now, and once more when it is over."""
        if self._tasks and not self._later:
            asyncio.get_running_loop().call_later(SETTLED, self._hurry_again)
        self._later.update(paths)
        self._hurried.update(paths)
        self._hurry.set()
        self._suspect.set()

    def _hurry_again(self) -> None:
        self._hurried.update(self._later)
        self._later.clear()
        self._hurry.set()

    def _tell(self, event: str, value: Any) -> None:
        message = framed(event, value)
        for viewer in list(self._viewers.values()):
            viewer.put(message)

    def _tell_all(self) -> None:
        for viewer in list(self._viewers.values()):
            viewer.put(self._snapshot(viewer))

    def _snapshot(self, viewer: Viewer) -> bytes:
        picture = self.picture
        return framed(
            "snapshot",
            {
                "viewer": viewer.number,
                "system": picture.system,
                "pid": picture.pid,
                "now": time.time(),
                "rows": list(picture.rows.values()),
                "processes": picture.processes,
                "troubles": self._troubles,
                "quarantine": self._put_aside,
                "is_judged": self._is_judged,
                "events": list(self._events),
                "problem": self._problem,
            },
        )

    # -- looking ------------------------------------------------------------------------------------------------------

    async def _again(self, work: Any) -> None:
        """Do it again and again; while the system does not answer, say so and go on asking."""
        while True:
            try:
                await work()
            except (HoldfastError, msgspec.MsgspecError) as error:  # The latter: a system of another version.
                # One of the works tells it: if the system does not answer, none of them gets on.
                if work == self._look_on:
                    self._say_problem(str(error))
                await asyncio.sleep(AGAIN)

    async def _look_on(self) -> None:
        """Look at all actors as often as that costs little, and at those on the screens, or told of, in between."""
        loop = asyncio.get_running_loop()
        next_all = next_some = 0.0
        costs, costs_of_some = (deque([0.0], maxlen=2) for _ in "ab")  # The dearer of two may have met something slow.
        while True:
            self._hurry.clear()
            begun, clock = loop.time(), time.perf_counter()  # The loop's own clock may have milliseconds only.
            some = self._hurried.union(*(viewer.watched for viewer in self._viewers.values()))
            if begun >= next_all or len(some) > MOST_AT_ONCE or self._has_changed or not self._is_seen:
                self._has_changed = False
                self._hurried.clear()
                self._take(await self._look(None), None)
                costs.append(time.perf_counter() - clock)
                next_all = loop.time() + min(RAREST, max(QUICKEST, min(costs) / SHARE_OF_ALL))
                next_some = loop.time() + QUICKEST
            elif some and (begun >= next_some or self._hurried) and next_all - begun > QUICKEST:
                self._hurried.clear()
                self._take(await self._look(tuple(some)), some)
                costs_of_some.append(time.perf_counter() - clock)
                next_some = loop.time() + min(RAREST_SOME, max(QUICKEST, min(costs_of_some) / SHARE))
            await asyncio.sleep(QUICKEST / 4)  # However many events there are, the loop is left to others.
            is_watched = any(viewer.watched for viewer in self._viewers.values())
            due = min(next_all, next_some) if is_watched and next_all - loop.time() > QUICKEST else next_all
            try:
                async with asyncio.timeout(max(0.0, due - loop.time())):
                    await self._hurry.wait()
            except TimeoutError:
                pass

    def _say_problem(self, text: str) -> None:
        if text != self._problem:
            self._problem = text
            self._tell("problem", {"text": text})

    async def _look(self, paths: tuple[str, ...] | None) -> SystemLook:
        told = f"nothing for more than {SILENT:g} s; what is shown is how it was"
        late = asyncio.get_running_loop().call_later(SILENT, self._say_problem, told)
        try:
            found: SystemLook = LOOK.decode(await self._answers.ask(Overview(paths=paths), ANSWER))
        finally:
            late.cancel()
        return found

    def _take(self, look: SystemLook, asked: Collection[str] | None) -> None:
        now = time.time()
        if asked is not None:
            change = self.picture.take_some(look, asked, now)
            if self._problem:  # It was silent, and answers again.
                self._problem = ""
                self._tell_all()
                return
        else:
            whole = self.picture.take(look, now)
            if whole is None or not self._is_seen or self._problem:
                self._is_seen, self._problem = True, ""
                self._suspect.set()
                self._tell_all()
                return
            change = whole
        if change.is_empty:
            return
        if any(added.row.state != "running" for added in change.rows) or change.gone:
            self._suspect.set()
        self._tell("change", change)

    # -- events -------------------------------------------------------------------------------------------------------

    async def _follow(self) -> None:
        """Hear of what happens, at once: whom it is about is looked at, and asked why if it sounds bad."""
        now = time.time()
        told = await self._page(AskHistory(question(kinds=TELLING, since=now - NEWS)))
        self._hear(told.events)
        page = await self._page(AskHistory(question(limit=KEPT)))
        self._events = deque(page.events, maxlen=KEPT)
        if self._is_seen:
            self._tell("events", page.events)
        after = page.next
        while True:
            page = await self._page(AskHistory(question(after=after), ONE_WAIT))
            after = page.next
            if page.events:
                self._events.extend(page.events)
                self._hear(page.events)
                self._has_changed |= any(event.kind in CHANGING for event in page.events)
                self.hurry({event.address for event in page.events})
                self._tell("events", page.events[-KEPT:])

    async def _page(self, asked: AskHistory) -> HistoryPage:
        return msgspec.convert(await self._answers.ask(asked, ANSWER + asked.wait), HistoryPage)

    def _hear(self, events: list[PastEvent]) -> None:
        for event in events:
            if event.kind in TELLING:
                self._told[event.address] = event.at
                if "/ftm/" in event.address:  # A part of a mechanism: the actor that it protects is meant.
                    self._told[event.address.partition("/ftm/")[0]] = event.at
                    del self._told[event.address]

    # -- troubles -----------------------------------------------------------------------------------------------------

    async def _ask_why(self) -> None:
        """Ask those who look ill why, soon after something has happened, and now and then."""
        loop = asyncio.get_running_loop()
        asked = set[str]()
        pause, next_round = TOGETHER, 0.0
        while True:
            self._suspect.clear()  # Now: what is told while somebody is asked is asked about by the next round.
            if self._is_seen and (loop.time() >= next_round or set(suspects(self._seen())) != asked):
                begun = time.perf_counter()
                asked = await self._ask_suspects()
                pause = min(RAREST, max(TOGETHER, (time.perf_counter() - begun) / SHARE_OF_ALL))
                next_round = loop.time() + max(1.0, pause)
            try:
                async with asyncio.timeout(SUSPECTING):
                    await self._suspect.wait()
                next_round = 0.0
                await asyncio.sleep(min(pause, RAREST_SOME))  # What comes at the same time is asked about together.
            except TimeoutError:
                pass  # Somebody may look ill without anything having been told: a turn that goes on and on.

    def _seen(self) -> SeenSystem:
        """What is known before anybody is asked."""
        memory = {one.pid: one.memory_bytes for one in self.picture.processes}
        addresses = frozenset(one.address for one in self._put_aside)
        return SeenSystem(time.time(), f"/{self.picture.system}", self.picture.rows, memory, addresses, self._told)

    async def _ask_suspects(self) -> set[str]:
        """One round: who looks ill is asked why, and what has changed of the answers is told. Returns whom it asked."""
        raw = await self._answers.ask(AskQuarantined(None), ANSWER)
        before, self._put_aside = self._put_aside, msgspec.convert(raw, list[PutAside])
        self._told = {path: at for path, at in self._told.items() if time.time() - at < NEWS}
        seen = self._seen()
        asked = suspects(seen)
        try:
            answers = await self._answers.ask(AskCauses(tuple(asked), 1.0), 3 * ANSWER)
        except SpecError:  # It keeps no history: what can be seen of them has to do.
            answers = {path: seen_causes(seen, path) for path in asked}
        found = sorted([*self._diagnosed, *troubles(seen, answers)], key=grade_of)
        if (found, self._put_aside) != (self._troubles, before) or not self._is_judged:
            self._troubles, self._is_judged = found, True
            self._tell("troubles", {"troubles": found, "quarantine": self._put_aside})
        return set(asked)

    async def _ask_diagnosis(self) -> None:
        """Ask what diagnosis says, now and then; where none runs, rarely: one may be started later."""
        while True:
            begun = time.perf_counter()
            try:
                self._diagnosed = diagnosed_troubles(await self._answers.ask(AskDiagnosis(None, 2.0), ANSWER))
                pause = 1.0
            except NotDiagnosed:
                self._diagnosed, pause = [], 2 * RAREST
            await asyncio.sleep(min(2 * RAREST, max(pause, (time.perf_counter() - begun) / SHARE_OF_ALL)))


def framed(event: str, value: Any) -> bytes:
    """A message of a stream of server-sent events; its JSON has no line ends."""
    return b"event: " + event.encode() + b"\ndata: " + plain(value) + b"\n\n"
