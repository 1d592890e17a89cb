"""The place of recorded lives in the root's own loop: to start such a child means to recover it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from ...actors.errors import StartFailed, StartIgnored
from ...actors.exit_reasons import start_failed
from ...actors.kernel import lifecycle
from ...actors.kernel.address_host import AddressHost
from ...actors.kernel.cell import DOWN, GONE, Cell
from ...actors.kernel.lifecycle import NEAR
from ..home.homes import ENDED, Homes
from ..home.journal_home import Entered, JournalHome
from ..life.recorded_life import Life, LifePlace
from ..method import Method
from ..protocol import ToHome


class LifeHere(LifePlace):
    """This event loop, for a life that a home at the root feeds."""

    def __init__(self, home: JournalHome) -> None:
        super().__init__()
        self.home = home
        self._starting: asyncio.Task[None] | None = None

    def start(self, cell: Cell) -> asyncio.Future[None]:
        start, home = cell.extra().start, self.home
        assert start is not None
        cell.table = start.kind._table
        entered = home.enter(cell)
        if home.is_gated:
            begun = self._step_by_step(cell, entered)
        else:
            home.isolated()
            self._begin(cell, entered)
            self._replay(cell, entered)
            begun = self._follow(cell, entered)
        self._starting = starting = lifecycle.outside_turn(cell, begun)
        starting.add_done_callback(self._started)
        return starting

    def _started(self, starting: asyncio.Future[None]) -> None:
        if self._starting is starting:
            self._starting = None

    def _begin(self, cell: Cell, entered: Entered) -> None:
        """S3, the new life with its state."""
        start, home, switch = cell.extra().start, self.home, entered.switch
        assert start is not None
        home.page = home.homes.page(switch)
        life = self.life = Life(cell, LocalHome(home, cell), home.method, home.page)
        for record in switch.restore_records():
            life.to_life(record)
        life.begin(start, switch.ledger.state_turn, switch.ledger.stash)
        assert home.clock is not None
        home.clock.mark("restart")

    def _replay(self, cell: Cell, entered: Entered) -> None:
        """S3, what it has handled since."""
        assert self.life is not None
        self.home.subscribe(cell, NEAR.topics(cell))
        entered.switch.attach(self.life)

    async def _step_by_step(self, cell: Cell, entered: Entered) -> None:
        """A recovery on whose way others have something to do."""
        await self.home.let_begin()
        if cell.state is not DOWN:
            raise StartFailed(cell.path, "it was stopped while it started")
        self._begin(cell, entered)
        await self.home.gate("replay")
        if not entered.live.done():  # Else it has ended meanwhile.
            self._replay(cell, entered)
        await self._follow(cell, entered)

    async def _follow(self, cell: Cell, entered: Entered) -> None:
        try:
            await self.home.until_live(cell, entered)
        except StartIgnored:
            await cell.ended()  # The next life begins when this one is over.
            raise
        except StartFailed as error:
            if cell.state not in (DOWN, GONE):  # Its replay diverged: the next life begins when this one is over.
                cell.kill()
                await cell.ended()
                raise
            if error.reason != ENDED:
                raise
            failed = start_failed(cell.path, cell.extra().reason)
            raise failed from failed.__cause__
        self.home.clock = self._starting = None

    def is_up(self, cell: Cell) -> bool:
        return True  # If its home is open.

    def kill(self, cell: Cell) -> None:
        if cell.state is DOWN and self._starting is not None:
            self._starting.cancel()
        else:
            super().kill(cell)

    def running(self, cell: Cell) -> int:
        feed = self.life.feed if self.life is not None else None
        return -1 if feed is None else feed.id

    def may_have_begun(self, cell: Cell, key: int) -> bool:
        return key == self.running(cell)

    def retired(self, cell: Cell) -> None:
        if self._starting is not None and not self._starting.done():
            self._starting.cancel()


class LocalHome:
    """From a life to its home, in one process."""

    def __init__(self, home: JournalHome, cell: Cell) -> None:
        self._home, self._cell = home, cell
        self._is_open = True

    def to_home(self, record: ToHome) -> None:
        switch = self._home.switch
        if switch is not None and self._is_open:
            switch.from_life(record)

    def when_told(self, then: Callable[[], None]) -> None:
        then()

    def closed(self) -> None:
        if self._is_open:
            self.shut()
            running = self._cell.host.place.running(self._cell)
            self._home.over(self._cell, running, ENDED, ordered=True)

    def shut(self) -> None:
        """What the life says from now on is not heard, nor its end: it has been moved away."""
        self._is_open = False


def recorded_here(homes: Homes, method: Method) -> AddressHost:
    """The host of a recorded actor that lives in this process."""
    home = JournalHome(homes, method, NEAR)
    return AddressHost(home, LifeHere(home), NEAR)
