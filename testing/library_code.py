"""Tells the code of this library from that of its user: the file decides, not the folder above it or a name.

A user's tests may live in a checkout of this library, where everything is below its root, beside it in a folder whose
name begins as its own, or in a folder called `holdfast` that makes their modules `holdfast.test_bank`.
"""

from __future__ import annotations

import os
import sys
from typing import Final

ROOMS: Final = ("actors", "checkpoint", "cluster", "console", "diagnosis", "ftm", "supervision", "system", "testing")
"""The folders of the package. What else is below its root (tests, examples, environments) is not the library's."""
MODULES: Final = ("adapters", "errors", "events")
"""The modules beside them."""
PREFIX: Final = __name__.partition(".")[0] + "."
ROOT: Final = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
"""Not resolved: the code of a package that is imported through a link has the link's path, as this file has."""
PLACES: Final = (
    *(os.path.join(ROOT, room, "") for room in ROOMS),
    *(os.path.join(ROOT, f"{module}.py") for module in MODULES),
)


def is_file_of_library(file: str) -> bool:
    """Whether a file of code is this library's own.

    >>> is_file_of_library(__file__), is_file_of_library(f"{ROOT}/tests/testing/test_bank.py")
    (True, False)
    """
    return file.startswith(PLACES)


def is_module_of_library(name: str) -> bool:
    """Whether a module is this library's own, by where it was loaded from.

    >>> is_module_of_library(__name__), is_module_of_library("holdfast.test_bank")
    (True, False)
    """
    if not name.startswith(PREFIX):
        return False
    file: str | None = getattr(sys.modules.get(name), "__file__", None)
    return file is not None and is_file_of_library(file)
