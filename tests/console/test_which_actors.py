"""Whom a command means by an address, a name or a pattern: the same wherever it takes a PATH."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.core import TyperGroup

import holdfast as hf
from holdfast.console.commands import commands
from holdfast.console.endpoint import control_endpoint
from holdfast.console.operate.reaching import ONE, WHOSE
from tests.console.commands import holdfast
from tests.history.players import Worker, failed

pytestmark = pytest.mark.usefixtures("warm_programs")

SEVERAL = {
    "tree", "top", "inspect", "suspend", "resume", "start", "stop", "restart", "remove", "protect", "checkpoint",
    "logs", "events", "dead-letters", "quarantine list", "quarantine retry", "quarantine drop",
}  # fmt: skip
ALONE = {"why", "history", "trace", "ask", "tell", "bind", "unbind", "diagnose"}


def arguments(group: Any, above: str = "") -> Iterator[tuple[str, Any]]:
    """All arguments of all commands that stand for actors, each with its command."""
    context: Any = None  # which no group of ours looks at
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        if isinstance(command, TyperGroup):
            yield from arguments(command, f"{above}{name} ")
        else:
            yield from ((above + name, one) for one in command.params if one.name in NAMES)


NAMES = ("path", "paths", "patterns", "owner", "target")


def test_help_says_of_each_command_whom_it_takes() -> None:
    said = {(command, str(one.help)) for command, one in arguments(typer.main.get_command(commands))}
    several = {name for name, text in said if text.startswith((WHOSE, "Addresses, names or patterns", "Only these"))}
    assert (several, {name for name, text in said if text.startswith(ONE)}) == (SEVERAL, ALONE)


async def test_quarantine_and_the_past_take_an_address_a_name_and_a_pattern(tmp_path: Path) -> None:
    socket = tmp_path / "s"
    async with hf.ActorSystem("app", log=False, intensity=100) as system, control_endpoint(system, socket):
        spec = hf.child(
            "a", hf.start(Worker), isolation="process", recovery=hf.hybrid(max_deliveries=1), register="till"
        )
        await failed(await system.start(spec), "kill")
        [message] = system.quarantined()

        async def said(*command: str) -> str:
            code, text, errors = await holdfast(*command, "--json", "--socket", socket)
            assert code == 0, errors
            return text

        for command, paths in (("quarantine", ("/app/a", "till", "/app/a*")), ("events", ("/app/a", "till"))):
            first, *others = await asyncio.gather(*(said(command, path) for path in paths))
            assert others == [first] * len(others)
            assert "/app/a" in first
        code, _, errors = await holdfast("quarantine", "drop", "/app/b*", "--yes", "--socket", socket)
        assert (code, "/app/b*: nothing of it is in quarantine" in errors) == (1, True)
        dropped = json.loads(await said("quarantine", "drop", "/app/**[names=till]", str(message.id), "--yes"))
        assert ([one["address"] for one in dropped["done"]], system.quarantined()) == (["/app/a"], [])
