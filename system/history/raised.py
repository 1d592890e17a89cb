"""Tracebacks for the history: as text at once, so that no frame and no local variable stays in memory."""

from __future__ import annotations

import functools
import linecache
import re
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, TracebackType

from ...actors.errors import error_text, type_name
from ...actors.exit_reasons import Crash

MOST_FRAMES = 12
"""Calls of one error that are kept, the innermost."""
MOST_CAUSES = 3
"""Errors of a chain that are kept, the last one raised last."""
LONGEST = 4_000
"""Characters that are kept of a traceback; of a longer one its end."""
ROOMS = ("actors", "adapters.py", "checkpoint", "console", "diagnosis", "ftm", "supervision", "system", "testing")
OURS = tuple(str(Path(__file__).parents[2] / room) for room in ROOMS)
"""Where this package is: where a user's error was raised is not there."""
FRAME = re.compile(r'^  File "(?P<file>[^"\n]{1,1000})", line (?P<line>\d{1,9}), in (?P<name>[^\n]{1,200})$', re.M)


def traceback_text(crash: Crash) -> str:
    """The traceback of a crash as Python would print it, of a bounded length."""
    if crash.error is None:
        return crash.formatted[-LONGEST:]
    parts: list[str] = []
    error: BaseException | None = crash.error
    for _ in range(MOST_CAUSES):
        if error is None:
            break
        parts.append("".join((*_frames(error.__traceback__), _said(error, crash))))
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
    return "\nwhich came of that:\n".join(reversed(parts))[-LONGEST:]


def _said(error: BaseException, crash: Crash) -> str:
    said = str(crash) if error is crash.error else f"{type_name(type(error))}: {error_text(error)}"
    return said[:500]


def _frames(at: TracebackType | None) -> Iterator[str]:
    found: deque[tuple[CodeType, int]] = deque(maxlen=MOST_FRAMES)
    while at is not None:
        found.append((at.tb_frame.f_code, at.tb_lineno or 0))
        at = at.tb_next
    for code, number in found:
        yield _line(code.co_filename, number, code.co_name)


@functools.lru_cache(maxsize=2_000)
def _line(file: str, number: int, name: str) -> str:
    """One call, as in a traceback. Where it stands is looked up once: actors fail at the same lines again and again."""
    source = linecache.getline(file, number).strip()[:200]
    shown = f"    {source}\n" if source else ""
    return f'  File "{file}", line {number}, in {name}\n{shown}'


def raised_at(traceback: str) -> str:
    """Where in the user's code an error was raised, `file.py:41`; "" if the traceback does not say.

    >>> raised_at('  File "/srv/shop.py", line 41, in resize\\n    1 // 0\\nZeroDivisionError')
    'shop.py:41'
    """
    found = [one for one in FRAME.finditer(traceback) if not one["file"].startswith(OURS)]
    return f"{found[-1]['file'].rpartition('/')[2]}:{found[-1]['line']}" if found else ""
