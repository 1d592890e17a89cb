"""The incidents of docs/five-incidents.md: real programs, found by the commands that the page shows, and mended."""

import asyncio
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.console.shown import is_shown, sections, steps

pytestmark = pytest.mark.usefixtures("warm_programs")

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs/five-incidents.md").read_text("utf-8")
SECTIONS = sections(PAGE, "##")
STARTED = dict(re.findall(r"^## ([^\n]+)\n(?:(?!^## ).)*?^`holdfast (run [^`]+)`$", PAGE, re.M | re.S))
VARIES = [
    (r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d(\.\d+ \d+(?= /)|\.\d+)?", "MOMENT"),
    (r"\b\d+(\.\d+)? (s|MB)\b", r"N \2"),
    (r"\b(pid|process|task|replicas) \d+", r"\1 N"),
    (r"\.py:\d+", ".py:N"),
]
"""What is another one each time: moments and numbers of events, seconds, sizes, processes, lines of the programs."""
CHANGES = re.compile(r"(holdfast (restart|quarantine (drop|retry))|kill|dd|rm) ")
"""Commands that change something; the others are given again until they say what is shown."""
REFUSED = re.compile(r"^\[exit \d+\]$", re.M)
"""It changed nothing: somebody to kill, say, has no process yet, for the program has only begun."""
PATIENCE = 30.0


def masked(text: str) -> str:
    for pattern, instead in VARIES:
        text = re.sub(pattern, instead, text)
    return text


def may_mount() -> bool:
    if shutil.which("unshare") is None or shutil.which("nsenter") is None:
        return False
    tried = subprocess.run([*OWN_MOUNTS, "mount", "-t", "tmpfs", "tmpfs", "/mnt"], capture_output=True, check=False)
    return tried.returncode == 0


OWN_MOUNTS = ["unshare", "--mount", *([] if os.geteuid() == 0 else ["--user", "--map-root-user"])]
INTO_THEM = ["nsenter", "--mount", *([] if os.geteuid() == 0 else ["--user", "--preserve-credentials"]), "--wd"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The programs of the page, in a folder of their own, with the command line on the path."""
    programs = tmp_path / "incidents"
    shutil.copytree(ROOT / "examples/incidents", programs, ignore=shutil.ignore_patterns("__pycache__"))
    (programs / "disk").mkdir()
    commands = tmp_path / "bin"
    commands.mkdir()
    (commands / "holdfast").write_text(f'#!/bin/sh\nexec {sys.executable} -m holdfast.console.cli "$@"\n')
    (commands / "holdfast").chmod(0o755)
    monkeypatch.setenv("PATH", f"{commands}:{os.environ['PATH']}")
    monkeypatch.delenv("HOLDFAST_SYSTEM", raising=False)
    with tempfile.TemporaryDirectory(dir="/tmp") as runtime:
        monkeypatch.setenv("XDG_RUNTIME_DIR", runtime)
        yield programs


async def said(before: list[str], line: str, folder: Path) -> str:
    """What a line of the shell prints, to both outputs, and its exit status if that is not 0."""
    process = await asyncio.create_subprocess_exec(
        *(*before, "bash", "-c", line),
        cwd=folder,
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )
    async with asyncio.timeout(PATIENCE):
        output, _ = await process.communicate()
    return output.decode() + (f"[exit {process.returncode}]\n" if process.returncode else "")


async def follows(before: list[str], line: str, shown: str, folder: Path) -> None:
    """A command says what is shown: at once if it has changed something, else before long."""
    output = ""
    try:
        async with asyncio.timeout(PATIENCE):
            while not is_shown(masked(shown), masked(output := await said(before, line, folder))):
                has_changed = CHANGES.match(line) is not None and not REFUSED.search(output)
                assert not has_changed, f"$ {line}\n{output}"
    except TimeoutError:
        raise AssertionError(f"$ {line}\n{output}\nis shown as\n{shown}") from None


@pytest.mark.parametrize("title", SECTIONS)
async def test_an_incident_is_found_and_mended(folder: Path, title: str) -> None:
    own: list[str] = []
    if "disk" in title:
        if not may_mount():
            pytest.skip("a disk that is full needs a file system of its own, and the kernel lets this user mount none")
        own = [*OWN_MOUNTS, "bash", "-c", 'mount -t tmpfs -o size=24m tmpfs disk && exec "$@"', "bash"]
    service = await asyncio.create_subprocess_exec(
        *(*own, sys.executable, "-m", "holdfast.console.cli", *STARTED[title].split()),
        cwd=folder,
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
    )
    before = [*INTO_THEM, "--target", str(service.pid)] if own else []
    assert service.stderr is not None
    draining: asyncio.Task[bytes] | None = None
    try:
        async with asyncio.timeout(PATIENCE):
            while b"shop runs" not in (told := await service.stderr.readline()):
                assert told, "the program has ended"
        draining = asyncio.create_task(service.stderr.read())
        for body in SECTIONS[title]:
            for line, shown in steps(body):
                await follows(before, line, shown, folder)
    finally:
        service.terminate()
        await service.wait()
        if draining is not None:
            await draining


def test_each_incident_has_a_program() -> None:
    assert set(STARTED) == set(SECTIONS)
    named = {started.split()[1].partition(":")[0] for started in STARTED.values()}
    assert named == {path.stem for path in (ROOT / "examples/incidents").glob("*.py")}


def test_what_varies_is_masked_and_nothing_else() -> None:
    shown = "2026-11-27 02:19:25.077 9 /shop restarted 3 times in the last 5 s, at shop.py:12, process 7, 60 MB"
    assert masked(shown) == "MOMENT /shop restarted 3 times in the last N s, at shop.py:N, process N, N MB"
