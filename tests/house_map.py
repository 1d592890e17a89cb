"""The map of the house: every folder and module of the package with the first sentence of its docstring.

`python -m tests.house_map` writes docs/map.md anew; tests/test_package.py sees to it that it is up to date.
"""

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("actors", "supervision", "checkpoint", "cluster", "ftm", "system", "diagnosis", "console", "testing")
HEAD = """# The map

Every folder and file of the package, with the first line of its docstring. `python -m tests.house_map` writes it.
"""


def first_line(file: Path) -> str:
    """The first line of a module's docstring."""
    return (ast.get_docstring(ast.parse(file.read_text("utf-8"))) or "").split("\n", 1)[0]


def folders() -> list[Path]:
    """All folders of the package, the root first, and a room's own before those inside it."""
    return [ROOT, *(init.parent for room in ROOMS for init in sorted((ROOT / room).rglob("__init__.py")))]


def text() -> str:
    """The page."""
    parts = [HEAD]
    for folder in folders():
        name = "holdfast" if folder == ROOT else folder.relative_to(ROOT)
        parts.append(f"## {name}\n\n{first_line(folder / '__init__.py')}\n")
        files = sorted(file for file in folder.glob("*.py") if file.name != "__init__.py")
        if files:
            parts.append("| file | |\n|---|---|\n" + "".join(f"| `{f.name}` | {first_line(f)} |\n" for f in files))
    return "\n".join(parts)


if __name__ == "__main__":
    (ROOT / "docs" / "map.md").write_text(text(), "utf-8")
