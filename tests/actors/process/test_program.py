"""An actor whose class is in the program itself: where its process cannot import that, the error says what to do."""

import subprocess
import sys
import zipapp
from pathlib import Path

import pytest

ACTOR = """
import holdfast as hf


class Ping(hf.Message[int]): ...


class Actor(hf.Actor):
    @hf.on(Ping)
    def ping(self, message: Ping) -> int:
        return 42


async def main():
    async with hf.ActorSystem("app", log=False) as system:
        try:
            actor = await system.start(hf.child("actor", hf.start(Actor), {how}))
        except hf.StartFailed as error:
            print(error)
        else:
            print(await actor.ask(Ping()))


"""
GUARD = 'if __name__ == "__main__":\n    '
RUN = "hf.run(main())\n"
PROCESS = ACTOR.replace("{how}", 'isolation="process"')


def output(*arguments: object, folder: Path, given: str = "") -> str:
    """What Python prints."""
    done = subprocess.run(
        [sys.executable, *map(str, arguments)], input=given, cwd=folder, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def file(folder: Path, name: str, text: str) -> Path:
    where = folder / name
    where.parent.mkdir(exist_ok=True)
    where.write_text(text)
    return where


def test_a_script_with_a_guard_works(tmp_path: Path) -> None:
    assert output(file(tmp_path, "program.py", PROCESS + GUARD + RUN), folder=tmp_path) == "42"


@pytest.mark.parametrize("how", ['isolation="process"', "mechanism=hf.ftm.PBR()"], ids=["process", "replicas"])
def test_a_script_without_a_guard_is_told_to_have_one(tmp_path: Path, how: str) -> None:
    said = output(file(tmp_path, "program.py", ACTOR.replace("{how}", how) + RUN), folder=tmp_path)
    assert said.startswith("/app/actor")
    assert 'put what it does under `if __name__ == "__main__":`' in said


@pytest.mark.parametrize("runner", ["hf.run", "__import__('asyncio').run"])
def test_a_script_without_a_guard_does_nothing_twice(tmp_path: Path, runner: str) -> None:
    """What it did before it wanted a process it had done again, in the process that imports the program."""
    begins = "as system:\n        print('charges a customer')\n"
    program = PROCESS.replace("as system:\n", begins) + f"{runner}(main())\n"
    said = output(file(tmp_path, "program.py", program), folder=tmp_path)
    assert said.count("charges a customer") == 1
    assert 'put what it does under `if __name__ == "__main__":`' in said


def test_a_script_that_cannot_be_imported_is_told_why(tmp_path: Path) -> None:
    program = "import sys\nif __name__ != '__main__':\n    raise OSError('no display')\n" + PROCESS + GUARD + RUN
    assert "OSError: no display" in output(file(tmp_path, "program.py", program), folder=tmp_path)


def test_a_module_that_is_run_by_its_name_works(tmp_path: Path) -> None:
    file(tmp_path, "package/__init__.py", "")
    file(tmp_path, "package/program.py", PROCESS + GUARD + RUN)
    assert output("-m", "package.program", folder=tmp_path) == "42"


def test_a_package_that_is_run_is_told_to_use_another_module(tmp_path: Path) -> None:
    file(tmp_path, "package/__init__.py", "")
    file(tmp_path, "package/__main__.py", PROCESS + GUARD + RUN)
    said = output("-m", "package", folder=tmp_path)
    assert "it is the __main__.py of the package package; move the class to another module of the package" in said


def test_an_archive_is_told_to_use_another_module(tmp_path: Path) -> None:
    file(tmp_path, "app/__main__.py", PROCESS + GUARD + RUN)
    zipapp.create_archive(tmp_path / "app", tmp_path / "app.pyz")
    assert "move the class to another module in there" in output("app.pyz", folder=tmp_path)


def test_code_that_is_given_with_c_or_piped_in_is_told_to_become_a_file(tmp_path: Path) -> None:
    program = PROCESS + GUARD + RUN
    for said in (output("-c", program, folder=tmp_path), output("-", folder=tmp_path, given=program)):
        assert "write it into a .py file" in said


def test_a_prompt_or_notebook_is_told_to_use_a_file(tmp_path: Path) -> None:
    program = file(tmp_path, "cells.txt", PROCESS + RUN)
    said = output("-i", folder=tmp_path, given=f"exec(open({str(program)!r}).read())\n")
    assert "write the class into a .py file, and import it from there" in said


@pytest.mark.parametrize("runner", ["hf.run", "__import__('asyncio').run"])
def test_nothing_is_left_open_at_a_normal_end(tmp_path: Path, runner: str) -> None:
    program = file(tmp_path, "program.py", PROCESS + GUARD + f"{runner}(main())\n")
    command = [sys.executable, "-X", "dev", str(program)]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, "42\n")
    assert "ResourceWarning" not in done.stderr
