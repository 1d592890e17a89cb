"""A hook of MkDocs: what a page links to outside of the book becomes the path of that file."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

LINK = re.compile(r"\[(?P<text>[^\]\[]+)\]\((?P<to>(?:\.\./)+[^)#\s]+)\)")
DOCS = Path(__file__).parent


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Put the path of a file in the place of a link to it, which would lead out of the book.

    Raises:
        FileNotFoundError: there is no such file.
    """
    folder = (DOCS / page.file.src_uri).parent

    def said(found: re.Match[str]) -> str:
        target = (folder / found["to"]).resolve()
        if target.is_relative_to(DOCS):
            return found[0]
        if not target.exists():
            raise FileNotFoundError(f"{page.file.src_uri} links to {found['to']}, which is not there")
        path = f"`{target.relative_to(DOCS.parent)}`"
        return path if found["text"].strip("`") in path else f"{found['text']} ({path})"

    return LINK.sub(said, markdown)
