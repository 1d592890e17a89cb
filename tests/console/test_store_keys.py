"""All commands that take a store take its key, from an option or the environment, and refuse it alike."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import typer
from typer.core import TyperGroup
from typer.testing import CliRunner

import holdfast as hf
from holdfast.console.commands import commands

pytestmark = pytest.mark.usefixtures("warm_programs")

RIGHT, WRONG = bytes(range(32)), bytes(32)
TAKES_NONE = {"nats"}
"""Groups of commands whose stores are servers."""


class Note(hf.Message): ...


class Kept(hf.Actor):
    @hf.on(Note)
    def note(self, message: Note) -> None: ...


tree = hf.child("kept", hf.start(Kept), recovery=hf.hybrid())


async def main(system: hf.ActorSystem) -> None:
    """What `holdfast run` runs: it ends at once."""


class Folder(NamedTuple):
    """Where an encrypted store and two keys are."""

    at: Path

    @property
    def store(self) -> str:
        return str(self.at / "app.db")

    def key(self, name: str) -> str:
        return str(self.at / name)

    def new(self) -> str:
        return str(self.at / f"copy{len(list(self.at.iterdir()))}.db")


CALLS: dict[str, Callable[[Folder], list[str]]] = {
    "check-upgrade": lambda one: [one.store, f"{__name__}:tree"],
    "replay": lambda one: [one.store, "/app/kept"],
    "doctor": lambda one: [one.store],
    "run": lambda one: [f"{__name__}:main", "--store", f"sqlite:{one.store}"],
    "store verify": lambda one: [one.store],
    "store stats": lambda one: [one.store],
    "store export": lambda one: [one.store],
    "store compact": lambda one: [one.store],
    "store erase": lambda one: [one.store, "/app/nobody", "--yes"],
    "store backup": lambda one: [one.store, one.new()],
    "store restore": lambda one: [one.store, one.new()],
    "store copy": lambda one: [f"sqlite:{one.store}", f"sqlite:{one.new()}"],
    "store rekey": lambda one: [one.store, one.new(), "--plain"],
}


@pytest.fixture(scope="module")
def encrypted(tmp_path_factory: pytest.TempPathFactory) -> Folder:
    folder = Folder(tmp_path_factory.mktemp("encrypted"))
    for name, key in (("right", RIGHT), ("wrong", WRONG)):
        Path(folder.key(name)).write_bytes(key)
        Path(folder.key(name)).chmod(0o600)

    async def recorded() -> None:
        async with hf.ActorSystem("app", store=f"sqlite:{folder.store}", store_key=RIGHT, log=False) as system:
            await (await system.start(tree)).send(Note())

    asyncio.run(recorded())
    return folder


def taking_a_store(name: str = "", command: Any = None) -> Iterator[tuple[str, Any]]:
    """The commands one of whose parameters is a store, by what they or their help call it."""
    command = command or typer.main.get_command(commands)
    if isinstance(command, TyperGroup):
        for one in command.list_commands(typer.Context(command)):
            if one not in TAKES_NONE:
                yield from taking_a_store(f"{name} {one}".strip(), command.get_command(typer.Context(command), one))
    elif any("store" in f"{one.name} {one.help or ''}".lower() for one in command.params):
        yield name, command


def test_each_command_that_takes_a_store_takes_its_key() -> None:
    found = dict(taking_a_store())
    assert found.keys() == CALLS.keys()
    for name, command in found.items():
        (option,) = (one for one in command.params if "--key-file" in one.opts)
        assert option.envvar == "HOLDFAST_STORE_KEY_FILE", name


@pytest.mark.parametrize("command", CALLS)
def test_the_key_of_a_store_is_used_or_refused(
    encrypted: Folder, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def said(*options: str) -> tuple[int, str]:
        done = CliRunner().invoke(commands, [*command.split(), *CALLS[command](encrypted), *options])
        return done.exit_code, done.output

    status, text = said()
    assert status != 0
    assert "it is encrypted, and there is no key for it" in text
    status, text = said("--key-file", encrypted.key("wrong"))
    assert status != 0
    assert "the key is not the one that it is encrypted with" in text
    monkeypatch.setenv("HOLDFAST_STORE_KEY_FILE", encrypted.key("right"))
    status, text = said()
    assert command == "doctor" or status == 0, text  # Of the machine it may find something.
    assert "its key" not in text
