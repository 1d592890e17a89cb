"""The default event loop of holdfast: uvloop where there is one, else asyncio's own (as on Windows).

This module imports uvloop, which takes time and is not everywhere: import it where a loop is made, not before.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

new_event_loop: Callable[[], asyncio.AbstractEventLoop]
try:
    import uvloop
except ImportError:
    new_event_loop = asyncio.new_event_loop
else:
    new_event_loop = uvloop.new_event_loop
