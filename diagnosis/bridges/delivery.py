"""Delivers something to another system again and again until it has arrived, and says when it does not."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from random import Random
from typing import Any, Final
from urllib.parse import urlsplit

from ...actors.backoff import Backoff
from ...actors.errors import SpecError
from ...actors.streams import is_loopback

PATIENCE: Final = 10.0
"""Seconds that the other side may take to answer."""
NEEDS: Final = "a bridge needs the library aiohttp: pip install 'holdfast[bridges]'"


def http_client() -> Any:
    """The library that speaks HTTP and websockets. Raises ImportError: it is not installed."""
    try:
        import aiohttp
    except ImportError as error:
        raise ImportError(NEEDS) from error
    return aiohttp


def check_url(owner: str, url: str, schemes: tuple[str, str], token: str | None, *, insecure: bool) -> None:
    """Refuse an address that is none, and a token that would go over a network in clear.

    Args:
        owner: who is to use it, for the error.
        url: the address.
        schemes: the one that is not encrypted, and the one that is, such as "http" and "https".
        token: is sent there; None: nothing secret is.
        insecure: whether it may go in clear.

    Raises:
        SpecError: see above.
    """
    parts = urlsplit(url)
    if parts.scheme not in schemes or not parts.hostname:
        raise SpecError(owner, f"{url!r} must be {schemes[0]}://HOST... or {schemes[1]}://HOST...")
    if token is not None and parts.scheme == schemes[0] and not (insecure or is_loopback(parts.hostname)):
        raise SpecError(
            owner,
            f"{parts.hostname} is another machine, and the token would go there in clear: write {schemes[1]}://, "
            "or insecure=True",
        )


async def keep_trying(attempt: Callable[[], Awaitable[None]], backoff: Backoff, rng: Random) -> None:
    """Make attempts, one after another, until this is cancelled; after one that has failed it waits.

    An attempt returns to be made again at once, and raises OSError or TimeoutError where it has failed.
    """
    failed = 0
    while True:
        try:
            await attempt()
            failed = 0
        except (OSError, TimeoutError):
            await asyncio.sleep(backoff.delay(failed, rng))
            failed += 1
