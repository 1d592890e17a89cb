"""`holdfast new`: a project from a template, whose test passes as it is."""

from __future__ import annotations

import keyword
import string
from pathlib import Path
from typing import Annotated, Final

import typer

from ..operate.reaching import UNUSABLE, ended

MESSAGES: Final = '''"""What the actors of $name are told. They have their own module: the others can be reloaded."""

import holdfast as hf


class Put(hf.Message[int]):
    """Put so many of an article into the stock; the answer is how many there are then."""

    count: int


class Take(hf.Message[int]):
    """Take so many; the answer is how many are left."""

    count: int


class Sell(hf.Message[str]):
    """Sell so many to a customer; the answer is for the customer."""

    count: int


class SoldOut(hf.Refusal, text="there are only {left} left"):
    """There are not so many."""

    left: int
'''
ACTORS: Final = '''"""The actors of $name."""

import holdfast as hf

from .messages import Put, Sell, SoldOut, Take


class Stock(hf.Actor):
    """How many there are of one article."""

    def __init__(self, count: int = 0) -> None:
        self.count = count

    @hf.on(Put)
    def put(self, message: Put) -> int:
        self.count += message.count
        return self.count

    @hf.on(Take)
    def take(self, message: Take) -> int:
        if message.count > self.count:
            raise SoldOut(self.count)
        self.count -= message.count
        return self.count


class Clerk(hf.Actor):
    """Sells what is in the stock to which it is bound."""

    stock: hf.Binding[Stock]

    @hf.on(Sell)
    async def sell(self, message: Sell) -> str:
        return f"{await self.stock.ask(Take(message.count))} are left"
'''
TREE: Final = '''"""What runs: `holdfast run $name.tree:tree --name $name`."""

import holdfast as hf

from .actors import Clerk, Stock


def tree() -> list[hf.ChildSpec]:
    """The children of the root."""
    articles = [hf.child(article, hf.start(Stock, 10), recovery=hf.hybrid()) for article in ("apples", "pears")]
    return [
        hf.supervisor("stock", intensity=5, period=10.0, children=articles),
        hf.child("clerk", hf.start(Clerk), bindings={"stock": "/$name/stock/apples"}),
    ]
'''
TEST: Final = '''"""The stock is kept, also over an end of its actor."""

import asyncio
from collections.abc import Awaitable, Callable

import holdfast as hf
import pytest
from $name.actors import Clerk, Stock
from $name.messages import Put, Sell, SoldOut, Take
from $name.tree import tree


def in_system(scenario: Callable[[hf.ActorSystem], Awaitable[None]]) -> None:
    async def main() -> None:
        async with hf.ActorSystem("$name", log=False) as system:
            for spec in tree():
                await system.start(spec)
            await scenario(system)

    asyncio.run(main())


def test_what_is_put_can_be_sold() -> None:
    async def scenario(system: hf.ActorSystem) -> None:
        assert await system.ref("/$name/stock/apples", Stock).ask(Put(5)) == 15
        assert await system.ref("/$name/clerk", Clerk).ask(Sell(3)) == "12 are left"
        with pytest.raises(SoldOut):
            await system.ref("/$name/stock/apples", Stock).ask(Take(100))

    in_system(scenario)


def test_the_stock_survives_the_end_of_its_actor() -> None:
    async def scenario(system: hf.ActorSystem) -> None:
        pears = system.ref("/$name/stock/pears", Stock)
        assert await pears.ask(Put(5)) == 15
        await system.terminate(pears)
        assert await pears.ask(Take(0)) == 15

    in_system(scenario)
'''
PYPROJECT: Final = """[build-system]
requires = ["setuptools>=77"]
build-backend = "setuptools.build_meta"

[project]
name = "$name"
version = "0.1.0"
requires-python = ">=3.11"
dependencies = ["holdfast[cli]"]

[tool.setuptools]
packages = ["$name"]

[tool.pytest.ini_options]
pythonpath = ["."]
testpaths = ["tests"]
asyncio_default_fixture_loop_scope = "function"
"""
DOCKERFILE: Final = """FROM python:3.13-slim
RUN useradd --create-home $name && mkdir -p /var/lib/$name && chown $name /var/lib/$name
COPY . /opt/$name
RUN pip install --no-cache-dir /opt/$name
USER $name
WORKDIR /opt/$name
VOLUME /var/lib/$name
# PID 1 is the program itself: it handles SIGTERM. Give it time: docker stop -t 60
ENTRYPOINT ["holdfast", "run", "$name.tree:tree", "--name", "$name", "--store", "sqlite:/var/lib/$name/$name.db"]
HEALTHCHECK CMD ["holdfast", "tree", "--paths", "--system", "$name"]
"""
UNIT: Final = """[Unit]
Description=$name

[Service]
Type=notify-reload
User=$name
RuntimeDirectory=$name
RuntimeDirectoryMode=0700
Environment=XDG_RUNTIME_DIR=/run/$name
StateDirectory=$name
WorkingDirectory=/opt/$name
ExecStart=/opt/$name/.venv/bin/holdfast run $name.tree:tree --name $name --store sqlite:/var/lib/$name/$name.db
Restart=always
TimeoutStopSec=60
WatchdogSec=15
KillMode=mixed

[Install]
WantedBy=multi-user.target
"""
README: Final = """# $name

```sh
pip install -e . pytest
python -m pytest                                # its tests
holdfast run $name.tree:tree --name $name       # in one terminal
holdfast tree                                   # in another one
holdfast top
```

`$name/messages.py` says what is sent, `$name/actors.py` what is done, `$name/tree.py` what runs. `$name.service`
is a unit for systemd; `systemctl reload $name` has changed code taken up while it runs. `Dockerfile` makes an image.
"""
FILES: Final = {
    "pyproject.toml": PYPROJECT,
    "README.md": README,
    "Dockerfile": DOCKERFILE,
    ".dockerignore": ".venv\n.git\n__pycache__\n*.db*\n",
    ".gitignore": ".venv/\n__pycache__/\n*.egg-info/\n*.db*\n",
    "$name.service": UNIT,
    "$name/__init__.py": '"""$name, a program of actors."""\n',
    "$name/messages.py": MESSAGES,
    "$name/actors.py": ACTORS,
    "$name/tree.py": TREE,
    "tests/test_$name.py": TEST,
}


def write_project(name: str, folder: Path) -> list[Path]:
    """Write the files of a new project; returns them. Raises OSError: the folder is there, or cannot be made."""
    folder.mkdir(parents=True)
    written: list[Path] = []
    for path, text in FILES.items():
        file = folder / string.Template(path).substitute(name=name)
        file.parent.mkdir(exist_ok=True)
        file.write_text(string.Template(text).substitute(name=name), "utf-8")
        written.append(file)
    return written


def new(
    name: Annotated[str, typer.Argument(help="The name of the project and of its package.")],
    folder: Annotated[Path | None, typer.Option(help="Where it is written; if left out, a folder of its name.")] = None,
) -> None:
    """Begin a project: messages, actors, a tree, a test that passes, a unit for systemd, a Dockerfile.

    Exit status 0: written. 2: the name is no name of a package, or the folder is there already.
    """
    if not name.isidentifier() or keyword.iskeyword(name) or name == "holdfast" or not name.isascii():
        raise ended("new", f"{name!r} is no name of a Python package: write letters, digits and _", UNUSABLE)
    where = folder or Path(name)
    try:
        files = write_project(name, where)
    except OSError as error:
        raise ended("new", f"{where}: {error.strerror or error}", UNUSABLE) from error
    for file in files:
        typer.echo(str(file))
    typer.echo(f"cd {where} && python -m pytest && holdfast run {name}.tree:tree --name {name}")
