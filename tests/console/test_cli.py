"""The command line: what it says when it cannot do what it is asked, and its exit status."""

import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from holdfast.console import cli
from holdfast.console.commands import commands

DIFFERS, UNUSABLE = 1, 2


def demo(*arguments: str) -> Result:
    return CliRunner().invoke(commands, ["demo", *arguments])


def test_it_prints_its_version() -> None:
    result = CliRunner().invoke(commands, ["--version"])
    assert result.exit_code == 0
    assert result.stdout.startswith("holdfast")


@pytest.mark.parametrize(("package", "extra"), [("typer", "cli"), ("rich", "cli"), ("numpy", "demo"), ("PIL", "demo")])
def test_a_missing_package_is_named_with_what_to_install(package: str, extra: str) -> None:
    text = cli.missing_extra(ModuleNotFoundError("gone", name=f"{package}.core"))
    assert f"'{package}'" in text
    assert f"pip install 'holdfast[{extra}]'" in text


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


def test_the_command_line_needs_nothing_of_the_demo(tmp_path: Path) -> None:
    done = bare("tree", "--socket", str(tmp_path / "gone.sock"))
    assert (done.returncode, done.stdout) == (UNUSABLE, "")
    assert "gone.sock" in done.stderr
    assert "pip install" not in done.stderr


def test_the_demo_names_its_own_extra(tmp_path: Path) -> None:
    done = bare("demo", "--log", str(tmp_path / "gone.g2o"))
    assert done.returncode == DIFFERS
    assert "pip install 'holdfast[demo]'" in done.stderr


def test_no_such_log(tmp_path: Path) -> None:
    result = demo("--log", str(tmp_path / "gone.g2o"))
    assert result.exit_code == UNUSABLE
    assert f"{tmp_path / 'gone.g2o'}: No such file" in result.stderr


def test_a_log_of_another_format_is_named_with_its_line(tmp_path: Path) -> None:
    log = tmp_path / "a.csv"
    log.write_text("# time and range\n1.0,2.0\n")
    result = demo("--log", str(log))
    assert result.exit_code == UNUSABLE
    assert f"{log}, line 2: neither a g2o record nor a comment" in result.stderr


def test_no_folder_for_the_picture(tmp_path: Path, small_log: Path) -> None:
    result = demo("--log", str(small_log), "--picture", str(tmp_path / "gone" / "maps.png"))
    assert result.exit_code == UNUSABLE
    assert "there is no folder" in result.stderr


@pytest.mark.parametrize("option", [("--kills", "-1"), ("--method", "prayer"), ("--speed", "-2"), ("--interval", "0")])
def test_an_option_out_of_range_is_refused(option: tuple[str, str]) -> None:
    result = demo(*option)
    assert result.exit_code == UNUSABLE
    assert option[0] in result.stderr
