"""The `holdfast nats` commands: write the files of servers for systems, check servers that run, remove a store."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Annotated
from urllib.parse import urlencode

import msgspec
import typer

from ..actors.errors import HoldfastError, SpecError
from ..cluster.configuration import read_configuration
from ..cluster.nats.server_check import check_store
from ..cluster.nats.server_file import ServerPlan, TlsFiles, host_and_port, write_server_files
from .operate.reaching import FAILED, UNUSABLE, Json, printable, show_json

nats = typer.Typer(
    name="nats",
    help="Set up NATS servers for systems on several machines, and check them.",
    no_args_is_help=True,
    add_completion=False,
)


@nats.command()
def config(
    folder: Annotated[Path, typer.Argument(help="Where the files go; it is made, for its owner alone.")],
    system: Annotated[list[str], typer.Option(help="A system that is kept there; give it again for more.")],
    host: Annotated[
        list[str] | None, typer.Option(help="A server, by the name that others reach it by: one, or three.")
    ] = None,
    port: Annotated[int, typer.Option(min=1, max=65000, help="For clients; counted up on one host.")] = 4222,
    cluster_port: Annotated[int, typer.Option(min=1, max=65000, help="For the servers among each other.")] = 6222,
    monitor_port: Annotated[int, typer.Option(min=0, max=65000, help="For health checks, on the machine.")] = 8222,
    store_dir: Annotated[str, typer.Option(help="Where JetStream keeps its files, on each machine.")] = "/var/lib/nats",
    certificate: Annotated[str | None, typer.Option(help="The certificate of a server, on its machine.")] = None,
    key: Annotated[str | None, typer.Option(help="The private key of that certificate, on its machine.")] = None,
    ca: Annotated[str | None, typer.Option(help="Who has signed the certificates, on each machine.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Write files of servers anew. Keys are kept always.")] = False,
) -> None:
    """Write the configuration of one NATS server, or of each of three, and a key for each role in each system.

    Servers on other hosts than 127.0.0.1 need --certificate, --key and --ca. The address that a program gives as its
    store stands behind the files.

    Exit status 0: the files are there. 2: they could not be written.
    """
    try:
        tls = _tls(certificate, key, ca)
        plans = _plans(host or ["127.0.0.1"], (port, cluster_port, monitor_port), store_dir, tls)
        files = write_server_files(folder, plans, system, force=force)
    except (HoldfastError, OSError) as error:
        raise _ended("config", error) from error
    for file in files:
        typer.echo(printable(str(file)))
    for one in system:
        typer.echo(printable(f'{one}: store="{store_address(plans, one, folder.resolve() / f"{one}-node.nk")}"'))


@nats.command()
def check(
    store: Annotated[str, typer.Argument(help="As in ActorSystem(store=...): nats://HOST,HOST/SYSTEM?nkey=FILE")],
    seconds: Annotated[float, typer.Option(min=0.1, max=600.0, help="How long each answer may take.")] = 5.0,
    as_json: Json = False,
) -> None:
    """Look whether servers, and the streams of a system there, may lose something that was acknowledged.

    Exit status 0: they do not, though there may be warnings. 1: they may. 2: no server answers, or STORE is not valid.
    """
    try:
        found = asyncio.run(check_store(store, seconds=seconds))
    except HoldfastError as error:
        raise _ended("check", error) from error
    if as_json:
        show_json(msgspec.to_builtins(found))
    else:
        for one in found:
            typer.echo(printable(f"{'warning' if one.is_warning else 'PROBLEM'}: {one}"))
        if not found:
            typer.echo("ok: what is acknowledged there stays")
    if not all(one.is_warning for one in found):
        raise typer.Exit(FAILED)


@nats.command()
def remove(
    store: Annotated[str, typer.Argument(help="As in ActorSystem(store=...): nats://HOST,HOST/SYSTEM?nkey=FILE")],
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
) -> None:
    """Remove all that a system has recorded on its servers, for good. No program may lead it.

    How servers are reached is said in their address, or by holdfast.toml and the environment.

    Exit status 0: nothing of it is there any more. 1: not confirmed. 2: a program leads the system, no server answers,
    or STORE is not valid.
    """
    from ..cluster.nats.access import access_of  # only now: it imports the library

    try:
        settings = read_configuration().nats.told()
        name = access_of(store, settings).name
        if not yes:
            typer.confirm(f"Remove all that is recorded at {printable(name)}, for good?", abort=True)
        from ..cluster.nats.store_removal import remove_store

        gone = asyncio.run(remove_store(store, settings))
    except HoldfastError as error:
        raise _ended("remove", error) from error
    for one in gone:
        typer.echo(f"removed {one}")
    if not gone:
        typer.echo("there was nothing")


def _ended(command: str, error: Exception) -> typer.Exit:
    """Tell what has gone wrong; some errors say themselves of which command that is."""
    typer.echo(f"holdfast nats {command}: {str(error).removeprefix(f'nats {command}: ')}", err=True)
    return typer.Exit(UNUSABLE)


def _tls(certificate: str | None, key: str | None, ca: str | None) -> TlsFiles | None:
    match certificate, key, ca:
        case None, None, None:
            return None
        case str(), str(), str():
            return TlsFiles(certificate, key, ca)
        case _:
            raise SpecError("nats config", "--certificate, --key and --ca belong together: give all or none")


def store_address(plans: list[ServerPlan], system: str, nkey: Path) -> str:
    """The address that a program of a system gives as its store; with TLS it has a certificate of its own to name."""
    told, tls = {"nkey": str(nkey)}, plans[0].tls
    if tls is not None:
        told |= {"ca": tls.ca, "certificate": "FILE", "key": "FILE"}
    servers = ",".join(host_and_port(plan.host, plan.port) for plan in plans)
    return f"{'nats' if tls is None else 'tls'}://{servers}/{system}?{urlencode(told, safe='/')}"


def _plans(hosts: list[str], ports: tuple[int, int, int], store_dir: str, tls: TlsFiles | None) -> list[ServerPlan]:
    """A plan for each host; servers that share one have ports that follow each other."""
    port, cluster_port, monitor_port = ports
    plans: list[ServerPlan] = []
    for number, host in enumerate(hosts):
        earlier = hosts[:number].count(host)
        plans.append(
            ServerPlan(
                name=f"nats-{number + 1}",
                host=host,
                store_dir=f"{store_dir.rstrip('/')}/nats-{number + 1}",
                port=port + earlier,
                cluster_port=cluster_port + earlier,
                monitor_port=monitor_port and monitor_port + earlier,
                tls=tls,
            )
        )
    return plans
