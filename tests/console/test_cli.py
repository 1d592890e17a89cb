"""The command line: what it says when it cannot do what it is asked, and its exit status."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

import holdfast as hf
from holdfast.console import cli
from holdfast.console.commands import commands

pytestmark = pytest.mark.usefixtures("warm_programs")

UNUSABLE = 2


def demo(*arguments: str) -> Result:
    return CliRunner().invoke(commands, ["demo", *arguments])


def test_it_prints_its_version() -> None:
    result = CliRunner().invoke(commands, ["--version"])
    assert result.exit_code == 0
    assert result.stdout.startswith("holdfast")


@pytest.mark.parametrize("package", ["typer", "rich", "textual"])
def test_a_missing_package_is_named_with_what_to_install(package: str) -> None:
    text = cli.missing_extra(ModuleNotFoundError("gone", name=f"{package}.core"))
    assert f"'{package}'" in text
    assert "pip install 'holdfast[cli]'" in text


def test_any_other_missing_module_is_an_error() -> None:
    with pytest.raises(ModuleNotFoundError):
        cli.missing_extra(ModuleNotFoundError("gone", name="msgspec"))


def test_without_typer_there_is_no_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "holdfast.console.commands")
    monkeypatch.setitem(sys.modules, "typer", None)
    with pytest.raises(SystemExit, match=r"pip install 'holdfast\[cli\]'"):
        cli.app()


BARE = """
import sys

for name in ("numpy", "PIL", "rtbdata"):
    sys.modules[name] = None  # as if it were not installed
from holdfast.console.cli import app


sys.argv[1:] = {arguments}
app()
"""


def bare(*arguments: str) -> subprocess.CompletedProcess[str]:
    """The command where only the extra `cli` is installed."""
    program = BARE.format(arguments=list(arguments))
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=120)


def test_the_command_line_needs_no_other_extra(tmp_path: Path) -> None:
    done = bare("tree", "--socket", str(tmp_path / "gone.sock"))
    assert (done.returncode, done.stdout) == (UNUSABLE, "")
    assert "gone.sock" in done.stderr
    assert "pip install" not in done.stderr


def test_the_demo_needs_no_other_extra() -> None:
    done = bare("demo", "--seconds", "0.1")
    assert (done.returncode, done.stderr) == (0, "")
    assert "Nothing was lost, nothing was doubled." in done.stdout


@pytest.mark.parametrize("option", [("--seconds", "0"), ("--method", "prayer"), ("--seed", "x")])
def test_an_option_out_of_range_is_refused(option: tuple[str, str]) -> None:
    result = demo(*option)
    assert result.exit_code == UNUSABLE
    assert option[0] in result.stderr


@pytest.mark.parametrize(
    "command",
    [["coverage"], ["store", "stats"], ["store", "export"], ["store", "verify"], ["store", "export", "--help"]],
    ids=" ".join,
)
async def test_a_command_whose_output_nobody_reads_ends_by_sigpipe(tmp_path: Path, command: list[str]) -> None:
    """No exit status of the command's own says that: 1 would say that a good store is damaged."""
    path = tmp_path / "app.db"
    async with hf.ActorSystem("t", log=False, store=f"sqlite:{path}"):
        pass
    arguments = [*command, str(path)] if command[0] == "store" else command
    reader, writer = os.pipe()
    os.close(reader)
    ended = subprocess.run(
        [sys.executable, "-m", "holdfast.console.cli", *arguments],
        stdout=writer,
        stderr=subprocess.PIPE,
        check=False,
        timeout=120,
    )
    os.close(writer)
    assert (ended.returncode, ended.stderr) == (-signal.SIGPIPE, b"")
