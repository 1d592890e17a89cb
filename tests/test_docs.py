"""What the documents show is true: every docstring example and every Python block in a Markdown file.

A block of a Markdown file is a part of a program that is made of all blocks of that file, in order. A block that opens
with a comment holding a path is a quotation instead: it must stand word for word in that file. A program comes to each
`except` of an error of holdfast that it shows.
"""

import ast
import doctest
import importlib
import importlib.util
import os
import pkgutil
import re
import signal
import subprocess
import sys
import textwrap
import types
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

import holdfast
import holdfast.events as hf_events

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])
TIME_LIMIT = 60.0  # seconds for all blocks of one document
FENCE = re.compile(
    r"^(?P<indent> *)(?P<fence>`{3,}|~{3,})(?P<info>[^`\n]*)\n(?P<body>.*?)^(?P=indent)(?P=fence)`* *$", re.M | re.S
)
INCLUDED = re.compile(r'--8<-- "(?P<path>examples/[\w./-]+)"\n')
QUOTATION = re.compile(r"# (?P<path>[\w./-]+\.\w+)\n")


class Block(NamedTuple):
    line: int  # of the document, counted from 1, where the body begins
    body: str


def module_names(paths: list[str], prefix: str) -> Iterator[str]:
    """Name every module below `paths` without importing any, as `pkgutil.walk_packages` would."""
    for found in pkgutil.iter_modules(paths, prefix):
        if found.name.endswith(".__main__"):
            continue  # a command, not a module: importing it runs it
        yield found.name
        if found.ispkg:
            yield from module_names([f"{path}/{found.name.removeprefix(prefix)}" for path in paths], f"{found.name}.")


def source_of(name: str) -> Path:
    """The file of a module, without importing it."""
    path = ROOT.joinpath(*name.split(".")[1:])
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


MODULES = ["holdfast", *module_names(list(holdfast.__path__), "holdfast.")]


def python_blocks(text: str) -> Iterator[Block]:
    for found in FENCE.finditer(text):
        language = found["info"].strip()
        assert not re.match(r"py(thon3|con)?\b(?!thon)|python\s+\S", language), f"write ```python, not ```{language}"
        if language == "python":
            yield Block(text.count("\n", 0, found.start("body")) + 1, textwrap.dedent(found["body"]))


def quoted_path(block: Block) -> str | None:
    found = QUOTATION.match(block.body)
    return found["path"] if found else None


def program(blocks: list[Block]) -> str:
    """Join the blocks that are to be run, each at its line of the document, so that a traceback names that line."""
    lines: list[str] = []
    for block in blocks:
        if quoted_path(block) is None:
            lines += [""] * (block.line - 1 - len(lines))
            lines += block.body.splitlines()
    return "\n".join(lines) + "\n" if lines else ""


class Branch(NamedTuple):
    line: int  # of `except`, counted from 1
    row: int  # where the first statement of the branch begins, counted from 0
    column: int  # in characters


def error_branches(text: str) -> Iterator[Branch]:
    """Each `except hf...` of a program, unless a statement with a body of its own comes first in it."""
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.ExceptHandler) or node.type is None or "hf." not in ast.unparse(node.type):
            continue
        first = node.body[0]
        if not any(isinstance(inner, ast.stmt) for inner in ast.iter_child_nodes(first)):
            line = text.splitlines()[first.lineno - 1]
            yield Branch(node.lineno, first.lineno - 1, len(line.encode()[: first.col_offset].decode()))


def marking(text: str, folder: Path) -> str:
    """The program, which leaves a file in `folder` for each `except hf...` that it comes to, named after the line."""
    lines = text.splitlines()
    for line, row, column in error_branches(text):
        mark = f"__import__('pathlib').Path({str(folder / str(line))!r}).touch(); "
        lines[row] = lines[row][:column] + mark + lines[row][column:]
    assert not lines[0], "a block begins behind the first line of its document"
    lines[0] = "__import__('warnings').simplefilter('error')"
    return "\n".join(lines) + "\n"


def run(path: Path) -> tuple[int, str]:
    """Run a script in a session of its own, killed at the time limit, and return its exit code and output.

    With `HOLDFAST_COLD` warnings are errors in the processes that it starts, too.
    """
    options = ["-W", "error"] if "HOLDFAST_COLD" in os.environ else []
    with subprocess.Popen(
        [sys.executable, *options, str(path)],
        cwd=path.parent,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    ) as process:
        try:
            output, _ = process.communicate(timeout=TIME_LIMIT)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            output, _ = process.communicate()
            output += f"\nstopped after {TIME_LIMIT:g} s"
    return process.returncode, output


def test_each_parameter_has_a_row_of_its_own_in_the_book() -> None:
    """Of a row for several the book would know no types and no defaults."""
    failures, count = doctest.testmod(named_module(ROOT / "docs/book_doctests.py"))
    assert (failures, count) == (0, 1)


def named_module(path: Path) -> types.ModuleType:
    """A module that belongs to no package, by its file."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", [name for name in MODULES if ">>>" in source_of(name).read_text("utf-8")])
def test_docstring_examples(name: str) -> None:
    module = importlib.import_module(name)
    failures, count = doctest.testmod(module, optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    assert failures == 0, "see the captured output"
    assert count > 0


def test_every_module_can_be_imported() -> None:
    for name in MODULES:
        assert Path(str(importlib.import_module(name).__file__)).samefile(source_of(name))


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_quotations(document: Path) -> None:
    for block in python_blocks(document.read_text("utf-8")):
        path = quoted_path(block)
        if path is None:
            continue
        quoted = block.body.split("\n", 1)[1].strip("\n")
        assert quoted in (ROOT / path).read_text("utf-8"), f"line {block.line}: this does not stand in {path}"


@pytest.mark.usefixtures("warm_programs")
@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_blocks_run(document: Path, tmp_path: Path) -> None:
    text = program(list(python_blocks(document.read_text("utf-8"))))
    if not text:
        return
    # A page of the name of a library must not be imported in its place.
    script, met = tmp_path / f"page_{document.stem.lower()}.py", tmp_path / "met"
    met.mkdir()
    script.write_text(marking(text, met), "utf-8")
    code, output = run(script)
    assert code == 0, output
    unmet = {branch.line for branch in error_branches(text)} - {int(one.name) for one in met.iterdir()}
    assert not unmet, "the errors of these lines were not met"


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_block_that_is_not_run_is_a_file_of_the_examples(document: Path) -> None:
    """As `pymdownx.snippets` includes it: nothing else is shown in a block with a language in braces."""
    for found in FENCE.finditer(document.read_text("utf-8")):
        if found["info"].strip().startswith("{"):
            included = INCLUDED.fullmatch(textwrap.dedent(found["body"]))
            assert included is not None, f"write ```python, not {found['info']}"
            assert (ROOT / included["path"]).is_file()


def test_blocks_keep_their_lines() -> None:
    quotation = "- b\n\n  ```python\n  # actors/kernel/ref.py\n  y = x\n  ```\n"
    text = f"# A\n\n```python\nx = 1\n```\n\n{quotation}\n```python\nprint(x)\n```\n"
    blocks = list(python_blocks(text))
    assert [(block.line, quoted_path(block)) for block in blocks] == [
        (4, None),
        (10, "actors/kernel/ref.py"),
        (15, None),
    ]
    assert program(blocks).splitlines() == ["", "", "", "x = 1", *[""] * 10, "print(x)"]


def test_an_error_that_is_not_met_is_noticed(tmp_path: Path) -> None:
    text = "\ntry:\n    raise hf.SendError\nexcept hf.SendError as é:\n    x = 'é'; y = x\nexcept hf.Hung:\n    pass\n"
    assert [branch.line for branch in error_branches(text)] == [4, 6]
    exec(compile(marking(text, tmp_path), "script", "exec"), {"hf": holdfast})
    assert [one.name for one in tmp_path.iterdir()] == ["4"]


@pytest.mark.parametrize("language", ["py", "python3", "pycon", "python no-run"])
def test_a_block_cannot_escape_by_its_language(language: str) -> None:
    with pytest.raises(AssertionError, match="write"):
        list(python_blocks(f"```{language}\n1 / 0\n```\n"))


CITED = re.compile(r"\b([RT])(\d+)([a-z]?)(?:-[RT](\d+))?\b")


def test_requirements_are_listed_if_tests_cite_them_and_cited_if_they_are_listed() -> None:
    """Those of recovery and the traps; a range, R29-R31, cites all in it."""
    listed = set(re.findall(r"^\| ([RT]\d+[a-z]?) \|", (ROOT / "docs/requirements.md").read_text(), re.MULTILINE))
    cited: set[str] = set()
    for path in (ROOT / "tests").rglob("*.py"):
        for letter, first, suffix, last in CITED.findall(path.read_text()):
            numbers = range(int(first), int(last or first) + 1)
            cited.update(f"{letter}{number}{suffix}" for number in numbers)
    assert listed == cited


def shown(name: str, documents: list[Path]) -> bool:
    return any(re.search(rf"\b{re.escape(name)}\b", document.read_text("utf-8")) for document in documents)


@pytest.mark.parametrize("room", ["", "adapters", "checkpoint", "ftm", "supervision", "system"])
def test_no_name_is_exported_that_no_document_shows(room: str) -> None:
    """The reference, the map and lists of what has moved show nothing."""
    documents = [
        path
        for path in DOCUMENTS
        if "reference" not in path.parts and path.name not in {"CHANGELOG.md", "map.md", "from-0.1-to-0.2.md"}
    ]
    names = importlib.import_module(f"holdfast.{room}" if room else "holdfast").__all__
    assert not [name for name in names if not name.startswith("_") and not shown(name, documents)]


@pytest.mark.parametrize("room", ["errors", "events"])
def test_errors_and_events_are_all_explained(room: str) -> None:
    """In the tables of one page, each."""
    text = (ROOT / "docs" / f"{room}.md").read_text("utf-8")
    names = importlib.import_module(f"holdfast.{room}").__all__
    assert not [name for name in names if f"{name}`" not in text]


def test_each_event_that_a_document_names_is_among_the_events() -> None:
    declared = re.compile(r"^class (\w+)\(Event\b", re.M)
    events = {name: module for module in MODULES for name in declared.findall(source_of(module).read_text())}
    for document in DOCUMENTS:
        for name in re.findall(r"`(?:hf\.events\.)?(\w+)(?:\([^`]*\))?`", document.read_text()):
            assert name not in events or name in hf_events.__all__, f"{document.name} calls {name} an event"
    assert len(events) > 90, "they are found"


def test_the_reference_has_every_public_name() -> None:
    """As a page of mkdocstrings has it: `::: holdfast.Actor`; rooms of errors and events are there as a whole."""
    text = "".join(path.read_text("utf-8") for path in sorted((ROOT / "docs" / "reference").glob("*.md")))
    there = set(re.findall(r"^::: holdfast\.(\S+)$", text, re.MULTILINE))
    for room in (
        "",
        "adapters",
        "checkpoint",
        "checkpoint.store_tools",
        "ftm",
        "supervision",
        "system",
        "system.upgrade",
    ):
        module = importlib.import_module(f"holdfast.{room}" if room else "holdfast")
        errors = set(importlib.import_module("holdfast.errors").__all__)
        wanted = {f"{room}.{name}".lstrip(".") for name in module.__all__ if name not in errors and name[0] != "_"}
        assert not wanted - there
    assert {"errors", "events"} <= there
