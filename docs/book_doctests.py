"""An extension of Griffe: examples in docstrings are shown as code, and each parameter has a row of its own."""

from __future__ import annotations

import re
from typing import Any

import griffe

EXAMPLE = re.compile(r"(?:^|(?<=\n\n))(?P<code>>>> .*?)(?=\n\n|\Z)", re.DOTALL)
ROW_OF_SEVERAL = re.compile(r"^ {4}(?P<names>\w+(?:, \w+)+):(?P<text>.*(?:\n {5,}.*)*)", re.MULTILINE)


class Doctests(griffe.Extension):
    """Puts each block of `>>>` lines between fences, and gives each of several names in a row the row for itself.

    Of a row for several parameters the book would know neither types nor defaults.
    """

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Change the docstring of one object."""
        if obj.docstring is not None:
            obj.docstring.value = shown(obj.docstring.value)


def shown(docstring: str) -> str:
    """The docstring as the book shows it.

    >>> print(shown("Wait.\\n\\nArgs:\\n    since, until: Unix times;\\n        both count.\\n    most: of them."))
    Wait.
    <BLANKLINE>
    Args:
        since: Unix times;
            both count.
        until: Unix times;
            both count.
        most: of them.
    """
    apart = ROW_OF_SEVERAL.sub(_rows, docstring)
    return EXAMPLE.sub(r"```pycon\n\g<code>\n```", apart)


def _rows(several: re.Match[str]) -> str:
    return "\n".join(f"    {name}:{several['text']}" for name in several["names"].split(", "))
