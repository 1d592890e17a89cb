"""Every command that docs/command-line.md shows does what it says there."""

import asyncio
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from holdfast.console.commands import PLACES
from holdfast.console.service.project import write_project
from tests.console.shown import is_shown, sections, steps
from tests.launched import python

pytestmark = pytest.mark.usefixtures("warm_programs")

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "command-line.md").read_text("utf-8")
SECTIONS = sections(PAGE, "###")
TREE = re.search(r"^```toml\n(.*?)^```$", PAGE, re.M | re.S)


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The program of the page, in its folder."""
    folder = tmp_path / "shop"
    write_project("shop", folder)
    assert TREE is not None
    (folder / "shop.toml").write_text(TREE[1])
    (folder / "shop.toml").chmod(0o600)
    monkeypatch.chdir(folder)
    monkeypatch.delenv("HOLDFAST_SYSTEM", raising=False)
    with tempfile.TemporaryDirectory(dir="/tmp") as runtime:
        monkeypatch.setenv("XDG_RUNTIME_DIR", runtime)
        yield folder


async def said(line: str) -> str:
    """What a command prints, to both outputs, and its exit status if that is not 0."""
    program, *arguments = shlex.split(line)
    assert program == "holdfast"
    done = await python("-m", "holdfast.console.cli", *arguments, stderr=subprocess.STDOUT, timeout=25)
    return done.stdout + (f"[exit {done.returncode}]\n" if done.returncode else "")


@pytest.mark.parametrize("title", SECTIONS)
async def test_the_page_is_true(project: Path, title: str) -> None:
    service = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "holdfast.console.cli", "run", "shop.tree:tree", "--name", "shop"),
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        assert service.stderr is not None
        async with asyncio.timeout(25):
            assert b"shop runs" in await service.stderr.readline()
        for body in SECTIONS[title]:
            for line, shown in steps(body):
                output = await said(line)
                assert is_shown(shown, output), f"$ {line}\n{output}"
    finally:
        service.terminate()
        await service.communicate()


def test_every_command_is_on_the_page() -> None:
    titles = re.findall(r"^### ([^\n]+)$", PAGE, re.M)
    shown = {name for title in titles for name in title.split(", ")}
    assert set(PLACES) - shown == {"check-upgrade", "replay", "demo", "store", "nats"}, "they have pages of their own"
