"""The shape of the package: one copy of it, what it exports, what importing it costs, and what it must never import."""

import ast
import importlib
import json
import re
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

import holdfast
from tests import house_map

ROOT = Path(__file__).resolve().parents[1]
BESIDE = {"tests", "benchmarks", "examples", "docs", "build", "dist"}
SOURCES = sorted(
    path.relative_to(ROOT)
    for path in [*ROOT.glob("*.py"), *ROOT.glob("[a-z]*/**/*.py")]
    if path.relative_to(ROOT).parts[0] not in BESIDE
)


def modules_after_import() -> list[str]:
    program = "import json, sys, holdfast; print(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True, timeout=60)
    names: list[str] = json.loads(done.stdout)
    return names


def imports(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the level and the name of each import of a source file; level 0 is an absolute import."""
    for node in ast.walk(ast.parse((ROOT / path).read_text("utf-8"))):
        match node:
            case ast.Import(names=names):
                yield from ((0, alias.name) for alias in names)
            case ast.ImportFrom(module=module, level=level):
                yield level, module or ""
            case _:
                pass


def test_a_fresh_process_holds_one_copy_of_the_package() -> None:
    assert [name for name in modules_after_import() if name.endswith("kernel.ref")] == ["holdfast.actors.kernel.ref"]


def test_pytest_holds_one_copy_of_the_package() -> None:
    assert [name for name in sys.modules if name.endswith("kernel.ref")] == ["holdfast.actors.kernel.ref"]


@pytest.mark.parametrize(
    "name",
    [
        "nats",
        "nkeys",
        "numpy",
        "holdfast.cluster.nats",
        "holdfast.console",
        "holdfast.diagnosis",
        "holdfast.testing",
        "opentelemetry",
    ],
)
def test_importing_holdfast_leaves_alone(name: str) -> None:
    assert name not in modules_after_import()


def public_names(room: ModuleType) -> list[str]:
    found = [
        name
        for name, value in vars(room).items()
        if not name.startswith("_") and not isinstance(value, ModuleType) and not name.isupper()
    ]
    return sorted(found)


ROOMS = ["adapters", "checkpoint", "errors", "events", "ftm", "supervision", "system"]


def test_all_is_sorted_and_complete() -> None:
    public = [name for name in holdfast.__all__ if not name.isupper()]
    # `__version__` is public by convention although it begins with an underscore.
    assert [name for name in public if name != "__version__"] == public_names(holdfast)
    assert list(holdfast.__all__) == sorted(holdfast.__all__)
    assert len(holdfast.__all__) < 75


def test_the_rooms_are_bound_and_only_they() -> None:
    """`import holdfast as hf` is enough for `hf.ftm.PBR`; other folders are imported by those who want them."""
    text = (ROOT / "__init__.py").read_text("utf-8")
    assert re.findall(r"^from holdfast import (\w+) as \1$", text, re.MULTILINE) == ROOMS


@pytest.mark.parametrize("name", ROOMS)
def test_a_room_exports_what_it_lists(name: str) -> None:
    room = importlib.import_module(f"holdfast.{name}")
    assert {one for one in public_names(room) if name != "adapters"} <= set(room.__all__)
    assert list(room.__all__) == sorted(set(room.__all__) & set(vars(room)))


@pytest.mark.parametrize("name", ["errors", "events"])
def test_errors_and_events_have_one_place(name: str) -> None:
    """No other room exports one, and the package itself only those errors that most programs name."""
    base = holdfast.HoldfastError if name == "errors" else holdfast.events.Event
    here = set(importlib.import_module(f"holdfast.{name}").__all__)
    for other in set(ROOMS) - {name}:
        room = importlib.import_module(f"holdfast.{other}")
        kinds = [one for one in room.__all__ if isinstance(getattr(room, one), type)]
        assert not [one for one in kinds if issubclass(getattr(room, one), base)]
    kinds = [one for one in holdfast.__all__ if isinstance(getattr(holdfast, one), type)]
    assert not {one for one in kinds if issubclass(getattr(holdfast, one), base)} - here


def test_the_version_is_that_of_the_distribution() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert holdfast.__version__ == project["version"]


def test_a_bare_install_has_all_public_names() -> None:
    modules = {
        "clingo",
        "cryptography",
        "nats",
        "numpy",
        "pddl",
        "PIL",
        "pytest",
        "rich",
        "textual",
        "typer",
        "yaml",
        "zstandard",
    }
    program = f"import sys; sys.modules.update(dict.fromkeys({sorted(modules)})); from holdfast import *; Actor"
    done = subprocess.run([sys.executable, "-c", program], check=False, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


def test_an_import_brings_nothing_that_few_programs_use() -> None:
    heavy = {"cryptography", "difflib", "email", "http", "importlib.metadata", "lzma", "multiprocessing", "psutil"}
    heavy |= {"shutil", "sqlite3", "statistics", "structlog", "tempfile", "uvloop"}
    program = f"import sys, holdfast; print(sorted(set({sorted(heavy)}) & sys.modules.keys()))"
    done = subprocess.run([sys.executable, "-c", program], check=False, capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == ("[]\n", "")


@pytest.mark.parametrize(
    ("package", "extra", "use"),
    [
        ("cryptography", "sec", "import holdfast.ftm.sec.authority"),
        ("prometheus_client", "metrics", "import holdfast.console.telemetry.metrics"),
        ("starlette", "dashboard", "import holdfast.console.dashboard"),
        ("uvicorn", "dashboard", "import holdfast.console.dashboard"),
        ("opentelemetry", "traces", "import holdfast; holdfast.ActorSystem().trace_with(None)"),
    ],
)
def test_what_needs_an_extra_says_which_one(package: str, extra: str, use: str) -> None:
    program = f"import sys; sys.modules[{package!r}] = None; {use}"
    done = subprocess.run([sys.executable, "-c", program], check=False, capture_output=True, text=True, timeout=60)
    assert f"pip install 'holdfast[{extra}]'" in done.stderr


def test_no_module_imports_pickle() -> None:
    found = [(str(path), name) for path in SOURCES for _, name in imports(path)]
    assert len(SOURCES) > 200
    assert not [one for one in found if one[1].split(".")[0] in {"pickle", "_pickle", "cloudpickle", "dill"}]


def test_one_folder_knows_the_client_of_nats() -> None:
    """What else is in the package works where the extra `nats` is not installed."""
    found = {path.parent for path in SOURCES for level, name in imports(path) if level == 0 and is_of_nats(name)}
    assert found <= {Path("cluster", "nats")}


def is_of_nats(name: str) -> bool:
    return name.split(".")[0] in {"nats", "nkeys"}


def test_every_refusal_says_a_sentence() -> None:
    """One without a text of its own shows its fields only."""
    found = {
        node.name: {word.arg for word in node.keywords}
        | {one.name for one in node.body if isinstance(one, ast.FunctionDef)}
        for path in SOURCES
        for node in ast.walk(ast.parse((ROOT / path).read_text("utf-8")))
        if isinstance(node, ast.ClassDef) and any(ast.unparse(base) == "Refusal" for base in node.bases)
    }
    assert {"ChildBusy", "KeyTaken", "NoRoute", "InputRefused", "RequestDropped"} <= found.keys()
    assert not [name for name, has in found.items() if not has & {"text", "__str__"}]


def test_modules_import_their_own_package_relatively() -> None:
    folders = {path.parts[0] for path in SOURCES if len(path.parts) > 1}
    # `import actors` would find the folder while the checkout is on sys.path, and load a second copy.
    inside = [path for path in SOURCES if path != Path("__init__.py")]
    found = [(str(path), name) for path in inside for level, name in imports(path) if level == 0]
    assert not [one for one in found if one[1].split(".")[0] in {"holdfast", *folders}]


def test_root_imports_absolutely() -> None:
    assert not [name for level, name in imports(Path("__init__.py")) if level]


def test_every_folder_of_the_package_is_shipped() -> None:
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["setuptools"]["packages"]
    assert sorted(listed) == sorted({".".join(("holdfast", *path.parts[:-1])) for path in SOURCES})
    assert all((ROOT / path.parent / "__init__.py").exists() for path in SOURCES)


def test_the_map_is_up_to_date() -> None:
    """If not: `python -m tests.house_map`."""
    assert (ROOT / "docs" / "map.md").read_text("utf-8") == house_map.text()


def test_each_module_stands_on_the_map_once() -> None:
    folder, found = "", Counter[str]()
    for line in house_map.text().splitlines():
        if line.startswith("## "):
            folder = line.removeprefix("## ").removeprefix("holdfast")
            found[str(Path(folder, "__init__.py"))] += 1
        elif line.startswith("| `"):
            found[str(Path(folder, line.split("`")[1]))] += 1
    assert found == Counter(map(str, SOURCES))


def test_no_folder_is_crowded_and_no_room_has_a_name_twice() -> None:
    names = Counter((path.parts[0], path.name) for path in SOURCES if path.name != "__init__.py")
    assert [name for name, count in names.items() if count > 1] == []
    files = Counter(path.parent for path in SOURCES if path.name != "__init__.py")
    assert {folder: count for folder, count in files.items() if count > 18} == {}


def test_fewer_and_fewer_imports_go_upwards() -> None:
    """Inside a room, for types too: what is mended leaves the list, which import-linter sees to, and none joins it."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]["contracts"]
    assert sum(len(one.get("ignore_imports", [])) for one in contracts) <= 47


def test_types_are_announced() -> None:
    assert (ROOT / "py.typed").read_text() == ""
