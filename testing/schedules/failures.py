"""Failures that are kept: the schedule that fails a test is tried first the next time, until it passes."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    import pytest

KEY = "holdfast/schedules"
MOST = 20
"""Schedules that are kept for one test."""


class Failures:
    """The schedules that have failed one test, in pytest's cache."""

    def __init__(self, config: pytest.Config, nodeid: str) -> None:
        self._cache: Any = getattr(config, "cache", None)
        record: str | None = config.getoption("holdfast_record", None)
        self._record = None if record is None else config.invocation_params.dir / record
        self._nodeid = nodeid

    def texts(self) -> list[str]:
        """The schedules, newest first."""
        return list(self._all().get(self._nodeid, []))

    def _all(self) -> dict[str, list[str]]:
        if self._cache is None:  # pytest -p no:cacheprovider
            return {}
        found = self._cache.get(KEY, {})
        return cast("dict[str, list[str]]", found) if isinstance(found, dict) else {}

    def add(self, text: str) -> None:
        """Keep one."""
        self._set([text, *(one for one in self.texts() if one != text)][:MOST])

    def drop(self, text: str) -> None:
        """It fails no more."""
        self._set([one for one in self.texts() if one != text])

    def _set(self, texts: list[str]) -> None:
        if self._cache is None:
            return
        kept = self._all()
        kept.pop(self._nodeid, None)
        if texts:
            kept[self._nodeid] = texts
        self._cache.set(KEY, kept)

    def folder(self) -> Path | None:
        """Where the files of this test's failure are written: below `--holdfast-record`, else in pytest's cache."""
        if self._record is None and self._cache is None:
            return None
        name = re.sub(r"[^\w.\[\]-]+", "_", self._nodeid)[-120:]
        return (self._record or cast("Path", self._cache.mkdir("holdfast-schedules"))) / name
