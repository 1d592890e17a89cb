"""Faults of a programmer, drawn at random and made in a copy of the package, one at a time: some test has to fail.

`python -m tests.mutation 20 [SEED]`, from the root of the repository, draws 20 lines and prints who survives. Tools
that do this (mutmut, cosmic-ray) either change the working tree or want the whole suite for each mutant, and know no
package whose folder is the repository; here the processes that a test starts have to import the mutant too.
"""

from __future__ import annotations

import ast
import copy
import functools
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from tests.removing import ROOT, copied

ROOMS = {
    "actors": ("tests/actors", "tests/control", "tests/migration"),
    "supervision": ("tests/supervision", "tests/control", "tests/system"),
    "checkpoint": ("tests/checkpoint",),
    "ftm": ("tests/ftm", "tests/migration"),
}
"""Where the lines are drawn, and which folders have the tests that are likely to see it."""
FILES, SECONDS = 10, 300.0
"""What a mutant survives: so many test files, the likeliest first, or so long."""

SWAPPED: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
SILENT = ("__repr__", "__str__", "__doc__")


class Mutant(NamedTuple):
    """One fault: the line, what is done to it, and the text of the file that has it."""

    file: str
    line: int
    what: str
    text: str

    def __str__(self) -> str:
        there = (ROOT / self.file).read_text().splitlines()[self.line - 1].strip()
        return f"{self.file}:{self.line}: {self.what}: {there}"


def faults(node: ast.AST) -> Iterator[tuple[str, ast.AST | None]]:
    """What can be done to a node: in words, and what stands there then (None: nothing)."""
    other: Any = copy.copy(node)
    match node:
        case ast.If(test=test) | ast.While(test=test) if not _is_constant(test):
            other.test = ast.UnaryOp(ast.Not(), test)
            yield "the condition is negated", other
        case ast.Compare(ops=[op]) if type(op) in SWAPPED:
            other.ops = [SWAPPED[type(op)]()]
            yield f"{type(op).__name__} becomes {SWAPPED[type(op)].__name__}", other
        case ast.BoolOp(op=op, values=values):
            yield "and, or are swapped", ast.BoolOp(ast.Or() if isinstance(op, ast.And) else ast.And(), values)
        case ast.Expr(value=ast.Call() | ast.Await()):
            yield "the call is dropped", None
        case ast.Assign(targets=[ast.Attribute() | ast.Subscript()]) | ast.AugAssign() | ast.Delete():
            yield "the statement is dropped", None
        case ast.Raise():
            yield "the raise is dropped", None
        case ast.Return(value=value) if value is not None and not _is_constant(value):
            yield "None is returned", ast.Return(ast.Constant(None))
        case ast.For(body=[_, *_]):
            other.body = [*node.body, ast.Break()]
            yield "the loop ends after its first round", other
        case ast.Constant(value=int(value)) if (
            not isinstance(value, bool) and value <= 16
        ):  # A larger one is some size.
            yield f"{value} becomes {value + 1}", ast.Constant(value + 1)
        case _:
            pass


def _is_constant(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) or (isinstance(node, ast.Name) and node.id == "TYPE_CHECKING")


def places(node: ast.AST) -> Iterator[tuple[ast.AST, str, int | None, ast.AST]]:
    """The nodes of code that runs, each with its parent and its place there; no annotations, no assertions."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "defaults", "kw_defaults", "msg"):
            continue
        for index, part in enumerate(value if isinstance(value, list) else [value]):
            if not isinstance(part, ast.AST) or isinstance(
                part, (ast.Assert, ast.Import, ast.ImportFrom, ast.JoinedStr)
            ):
                continue
            if isinstance(part, (ast.FunctionDef, ast.AsyncFunctionDef)) and part.name in SILENT:
                continue
            yield node, name, index if isinstance(value, list) else None, part
            yield from places(part)


Found = tuple[int, str, ast.AST, str, int | None, ast.AST | None]
"""A fault that can be made: line, words, parent, place, what stands there then."""


def found(tree: ast.Module) -> Iterator[Found]:
    """All faults that can be made in a module's functions."""
    functions = [one for one in ast.walk(tree) if isinstance(one, (ast.FunctionDef, ast.AsyncFunctionDef))]
    lines = {line for one in functions for line in range(one.body[0].lineno, (one.end_lineno or 0) + 1)}
    for parent, name, index, node in places(tree):
        line: int = getattr(node, "lineno", 0)
        if line in lines:
            for what, instead in faults(node):
                yield line, what, parent, name, index, instead


def mutants(file: str, text: str) -> Iterator[Mutant]:
    """All mutants of a module's functions."""
    tree = ast.parse(text)
    for line, what, *place in found(tree):
        yield Mutant(file, line, what, _text_with(tree, *place))  # type: ignore[arg-type]


def _text_with(tree: ast.Module, parent: Any, name: str, index: int | None, instead: ast.AST | None) -> str:
    """The module with something else at one place."""
    new = ast.Pass() if instead is None else instead
    before = getattr(parent, name)
    if index is None:
        setattr(parent, name, new)
    else:
        setattr(parent, name, [*before[:index], new, *before[index + 1 :]])
    try:
        return ast.unparse(ast.fix_missing_locations(tree))
    finally:
        setattr(parent, name, before)


def drawn(seed: int, count: int) -> list[Mutant]:
    """So many lines of these rooms, each with one fault: the same ones for the same seed and the same code."""
    chance = random.Random(seed)
    files = sorted(str(file.relative_to(ROOT)) for room in ROOMS for file in (ROOT / room).rglob("*.py"))
    sizes = [len((ROOT / file).read_text().splitlines()) for file in files]
    chosen: list[Mutant] = []
    seen: set[tuple[str, int]] = set()
    while len(chosen) < count:
        [file] = chance.choices(files, sizes)
        tree, possible = _found_in(file)
        if possible:
            line, what, *place = chance.choice(possible)
            if (file, line) not in seen:
                seen.add((file, line))
                chosen.append(Mutant(file, line, what, _text_with(tree, *place)))  # type: ignore[arg-type]
    return chosen


@functools.cache
def _found_in(file: str) -> tuple[ast.Module, list[Found]]:
    tree = ast.parse((ROOT / file).read_text())
    return tree, list(found(tree))


def likely(file: str) -> list[str]:
    """The test files of the module's rooms, those first that name it, or what it defines."""
    module, text = Path(file).with_suffix(""), (ROOT / file).read_text()
    names = {name for name in re.findall(r"(?:class|def) (\w+)", text) if not name.startswith("__")}
    tests = [test for folder in ROOMS[module.parts[0]] for test in sorted((ROOT / folder).rglob("test_*.py"))]
    tests = [test for test in tests if "campaign" not in test.stem and "removed" not in test.stem]

    def rank(test: Path) -> tuple[int, int]:
        said = test.read_text()
        imports = f"holdfast.{'.'.join(module.parts)} " in said
        near = test.stem.startswith(f"test_{module.stem}") or module.stem in test.stem.split("_")
        words = set(re.findall(r"\w+", said))
        beside = test.parent.name == module.parts[-2]
        return -(8 * near + 4 * imports + 2 * beside), -len(names & words)

    return [str(test.relative_to(ROOT)) for test in sorted(tests, key=rank)][:FILES]


def survives(folder: Path, mutant: Mutant) -> bool:
    """Whether no test fails. A test run that never ends has seen it too, unless its time was over before."""
    file = folder / mutant.file
    whole = file.read_text()
    file.write_text(mutant.text)
    options = ["-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist", "-o", "faulthandler_timeout=60"]
    run = subprocess.Popen(
        [sys.executable, "-m", "pytest", *options, *likely(mutant.file)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder / ".link"), "PYTHONDONTWRITEBYTECODE": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        return run.wait(SECONDS) == 0
    except subprocess.TimeoutExpired:
        return True
    finally:
        if run.poll() is None:
            os.killpg(run.pid, signal.SIGKILL)
            run.wait()
        file.write_text(whole)


def hunt(seed: int, count: int) -> list[Mutant]:
    """Make these mutants one after another, and say of each what becomes of it; returns the survivors."""
    sys.stdout.write(f"{count} mutants, seed {seed}\n")
    survivors: list[Mutant] = []
    with tempfile.TemporaryDirectory(prefix="holdfast-mutants-") as folder:
        copy_of_it = copied(Path(folder))
        for number, mutant in enumerate(drawn(seed, count), 1):
            if survives(copy_of_it, mutant):
                survivors.append(mutant)
            mark = "SURVIVES" if mutant in survivors else "seen"
            sys.stdout.write(f"{number:4} {mark:8} {mutant}\n")
            sys.stdout.flush()
    sys.stdout.write(f"{len(survivors)} of {count} survive (seed {seed})\n")
    return survivors


if __name__ == "__main__":
    hunt(int(sys.argv[2]) if len(sys.argv) > 2 else random.SystemRandom().randrange(2**32), int(sys.argv[1]))
