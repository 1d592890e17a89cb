"""Those who wait until there is something new to read."""

from __future__ import annotations

import asyncio


class Followers:
    """Futures of those who wait for the next thing that is kept; all of them end with it."""

    __slots__ = ("_waiting",)

    def __init__(self) -> None:
        self._waiting: list[asyncio.Future[None]] = []

    def __len__(self) -> int:
        return len(self._waiting)

    def changed(self) -> asyncio.Future[None]:
        """A future that ends with the next thing that is kept; it is cancelled if the system ends before."""
        future: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.append(future)
        future.add_done_callback(self._forget)
        return future

    def _forget(self, future: asyncio.Future[None]) -> None:
        if future in self._waiting:  # Whoever waited has been cancelled.
            self._waiting.remove(future)

    def tell(self) -> None:
        """There is something new: nobody has to wait any more."""
        waiting, self._waiting = self._waiting, []
        for future in waiting:
            if not future.done():
                future.set_result(None)

    def close(self) -> None:
        """Nothing comes any more: whoever waits is cancelled."""
        for future in list(self._waiting):
            future.cancel()
