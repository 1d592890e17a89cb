"""The pages about the inside of the package name files and tests that exist, and show pictures as they are drawn."""

import ast
import importlib.util
import re
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = [DOCS / "internals" / "index.md", DOCS / "internals" / "walks.md", DOCS / "papers.md"]
SHIPPED = ("actors", "supervision", "checkpoint", "cluster", "ftm", "diagnosis", "system", "console", "testing")
NAMED = re.compile(r"`(?P<file>[\w/]+\.py)(::(?P<test>\w+))?`")
LISTED = re.compile(r"^(?P<folder>[\w/]+)/: (?P<files>[\w., \n]+?\.py)$", re.M)
PICTURES = sorted((DOCS / "pictures").glob("*.txt"))


def painter() -> ModuleType:
    spec = importlib.util.spec_from_file_location("sequence", DOCS / "pictures" / "sequence.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@cache
def functions_in(file: Path) -> set[str]:
    tree = ast.parse(file.read_text("utf-8"))
    return {one.name for one in ast.walk(tree) if isinstance(one, (ast.FunctionDef, ast.AsyncFunctionDef))}


@cache
def known_files() -> set[str]:
    """Each file by its name alone, and by its path below its room, as a page about that room writes it."""
    found = [(room, file) for room in SHIPPED for file in (ROOT / room).rglob("*.py")]
    below = {str(file.relative_to(ROOT / room)) for room, file in found}
    return below | {file.name for _, file in found}


def is_there(name: str, test: str | None) -> bool:
    file = ROOT / name
    if test is not None:
        return file.exists() and test in functions_in(file)
    return file.exists() or name in known_files()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_what_a_page_names_exists(page: Path) -> None:
    named = list(NAMED.finditer(page.read_text("utf-8")))
    assert named
    assert [found[0] for found in named if not is_there(found["file"], found["test"])] == []


def test_the_files_of_the_walks_exist() -> None:
    found = list(LISTED.finditer((DOCS / "internals" / "walks.md").read_text("utf-8")))
    files = [ROOT / one["folder"] / name for one in found for name in re.split(r",\s+", one["files"])]
    assert len(files) > 300
    assert [str(file) for file in files if not file.exists()] == []


@pytest.mark.parametrize("text", PICTURES, ids=lambda text: text.stem)
def test_a_picture_is_what_its_text_says(text: Path) -> None:
    """If not: `python docs/pictures/sequence.py`."""
    module = painter()
    assert text.with_suffix(".svg").read_text("utf-8") == module.draw(module.read(text.read_text("utf-8")))


def test_a_line_that_cannot_be_drawn_is_named() -> None:
    with pytest.raises(ValueError, match="this line cannot be drawn: a is bored"):
        painter().read("Title\nDescription\nroot a: A\na is bored")
