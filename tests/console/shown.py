"""What a page of the documents shows of commands, compared with what they print."""

import doctest
import re
from collections.abc import Iterator

CONSOLE = re.compile(r"^```console\n(.*?)^```$", re.M | re.S)


def sections(page: str, level: str) -> dict[str, list[str]]:
    """The blocks of commands below each heading of this level."""
    found = re.findall(rf"^{level} ([^\n]+)\n(.*?)(?=^#{{2,{len(level)}}} |\Z)", page, re.M | re.S)
    return {title: CONSOLE.findall(body) for title, body in found if CONSOLE.search(body)}


def steps(body: str) -> Iterator[tuple[str, str]]:
    """The commands of a block, each with what is shown of its output."""
    for part in re.split(r"^\$ ", body, flags=re.M)[1:]:
        line, _, shown = part.partition("\n")
        yield line, shown


def is_shown(shown: str, output: str) -> bool:
    """Whether a page shows this output: `...` stands for anything, and lines may be broken elsewhere."""
    return doctest.OutputChecker().check_output(shown, output, doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
