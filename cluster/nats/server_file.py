"""Configuration files of NATS servers on which systems of holdfast may rely, and the keys of who may use them.

An account for each system is the boundary between systems: nobody in one sees anything of another. Inside it, nodes
trust each other; a client may send to the system, and an observer may look at who is there.
"""

from __future__ import annotations

import contextlib
import importlib
import ipaddress
import os
import re
import secrets
import stat
from collections.abc import Callable, Iterable, Sequence
from enum import StrEnum
from pathlib import Path
from types import ModuleType
from typing import Final, NamedTuple

import msgspec

from ...actors.errors import HoldfastError, SpecError
from ...actors.streams import is_loopback
from .private_files import read_private

MOST_BYTES: Final = 8 * 1024 * 1024
"""The largest message that a server takes: parts of records and blobs are smaller."""
VARZ: Final = "$SYS.REQ.SERVER.PING.VARZ"
"""Where each server answers how it is set up. The system account exports it, so that nodes can check the servers."""
NEEDS: Final = "a store on NATS needs the library nats-py: pip install 'holdfast[nats]'"
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")
_HOST: Final = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9._-]*[A-Za-z0-9_])?\.?")


class FileExists(HoldfastError, text="{path} is there already: give another folder, or --force, which writes it anew"):
    """A server file would replace one that somebody may have changed by hand."""

    path: str


class UserRole(StrEnum):
    """What somebody may do in the account of a system."""

    NODE = "node"
    CLIENT = "client"
    OBSERVER = "observer"


class TlsFiles(msgspec.Struct, frozen=True):
    """The certificate of one server, its key, and whom it trusts, as paths on the machine of that server."""

    certificate: str
    key: str
    ca: str


class ServerPlan(msgspec.Struct, frozen=True, kw_only=True):
    """One server to be configured.

    Attributes:
        name: unique among the servers of a cluster.
        host: the name or number that clients and the other servers reach it by, and that it listens on.
        port: for clients.
        cluster_port: for the other servers; not used where there are none.
        monitor_port: answers about its health over HTTP, on the loopback interface only; 0 for none.
        store_dir: where JetStream keeps its files, on a disk of this machine.
        most_stored_bytes: how much JetStream may keep there.
        tls: its certificate; needed where the host is not the loopback interface.
    """

    name: str
    host: str
    store_dir: str
    port: int = 4222
    cluster_port: int = 6222
    monitor_port: int = 8222
    most_stored_bytes: int = 64 * 1024**3
    tls: TlsFiles | None = None


class User(NamedTuple):
    """Somebody who may use a system: what for, and the public key that proves it."""

    role: UserRole
    key: str


class NatsAccount(NamedTuple):
    """One system on the servers, and who may use it."""

    system: str
    users: tuple[User, ...]


class Permissions(NamedTuple):
    """The subjects that a user may publish to and subscribe to; all others are refused."""

    publish: tuple[str, ...]
    subscribe: tuple[str, ...]


def check_name(where: str, name: str) -> str:
    """The name, if it can be part of a subject.

    Raises:
        SpecError: it cannot.
    """
    if not _NAME.fullmatch(name) or len(name) > 64:
        raise SpecError(where, f"{name!r} must be at most 64 letters, digits, hyphens and underscores, a letter first")
    return name


def check_host(where: str, host: str) -> str:
    """The host, if it is a number of a machine or can be its name.

    Raises:
        SpecError: it cannot.
    """
    if not (_HOST.fullmatch(host) and len(host) <= 253):
        try:
            ipaddress.IPv6Address(host.removeprefix("[").removesuffix("]"))
        except ValueError:
            problem = f"{host!r} is no host: give the name or the number of a machine, without port and scheme"
            raise SpecError(where, problem) from None
    return host


def inbox_of(key: str) -> str:
    """The prefix of the subjects on which the user with that public key gets answers; nobody else may listen there."""
    return f"_INBOX.{key}"


def permissions(system: str, user: User) -> Permissions:
    """What a user may do in the account of a system."""
    own = f"{inbox_of(user.key)}.>"
    everything = f"hf.{system}.>"
    match user.role:
        case UserRole.NODE:  # Nodes trust each other: a purge cannot be limited to one subject.
            return Permissions((everything, "$JS.API.>", "$JS.ACK.>", "$JS.FC.>", "_INBOX.>", VARZ), (everything, own))
        case UserRole.CLIENT:
            return Permissions((f"hf.{system}.*.in", f"hf.{system}.node.*.*.>"), (own,))
        case UserRole.OBSERVER:
            looks = ("INFO", "STREAM.NAMES", "STREAM.LIST", "STREAM.INFO.*", "CONSUMER.LIST.*", "CONSUMER.INFO.*.*")
            apis = (f"$JS.API.{one}" for one in looks)
            return Permissions((*apis, VARZ), (f"hf.{system}.beat.*", f"hf.{system}.*.lease", own))


def server_text(server: ServerPlan, cluster: Sequence[ServerPlan], accounts: Sequence[NatsAccount], secret: str) -> str:
    """The configuration file of one server.

    Args:
        cluster: all servers, this one included; one or three.
        accounts: the systems that may use them.
        secret: what the servers know each other by.

    Raises:
        SpecError: there are not one or three servers, two are of one name or address, a port is to serve twice, a host
            is none or has no certificate though others reach it, or a name cannot be part of a subject.
    """
    _check(cluster, accounts)
    lines = [
        f"server_name: {_quoted(server.name)}",
        f"listen: {_quoted(host_and_port(server.host, server.port))}",
        *([f'http: "127.0.0.1:{server.monitor_port}"'] if server.monitor_port else []),
        f"max_payload: {MOST_BYTES}",
        f"max_pending: {8 * MOST_BYTES}",
        'ping_interval: "2s"',
        "ping_max: 2",
        'write_deadline: "5s"',
        "jetstream {",
        f"  store_dir: {_quoted(server.store_dir)}",
        "  sync_interval: always # an acknowledged record is on the disk",
        f"  max_file_store: {server.most_stored_bytes}",
        "}",
        *_tls(server, ""),
    ]
    if len(cluster) > 1:
        known = f"holdfast:{secret}@"
        others = [host_and_port(one.host, one.cluster_port) for one in cluster if one != server]
        routes = [f"nats-route://{known}{other}" for other in others]
        lines += [
            "cluster {",
            '  name: "holdfast"',
            f"  listen: {_quoted(host_and_port(server.host, server.cluster_port))}",
            f"  authorization {{ user: holdfast, password: {_quoted(secret)} }}",
            f"  routes: {_listed(routes)}",
            *_tls(server, "  "),
            "}",
        ]
    systems = [account.system for account in accounts]
    lines += [
        "accounts {",
        f'  SYS {{ exports: [{{ service: "{VARZ}", response: stream, accounts: {_listed(systems)} }}] }}',
    ]
    for account in accounts:
        lines += _account(account)
    lines += ["}", "system_account: SYS"]
    return "\n".join(lines) + "\n"


def write_server_files(
    folder: Path, servers: Sequence[ServerPlan], systems: Iterable[str], *, force: bool = False
) -> list[Path]:
    """Write the configuration file of each server, and a key for each role in each system, all with mode 0600.

    Keys that are in the folder already are kept: who has a copy can go on. To add a system, write with it added.

    Args:
        folder: is made, for its owner alone, if it is not there.
        force: whether configuration files that are there are replaced.

    Returns:
        The files, those of the servers first.

    Raises:
        FileExists: a configuration file is there, and it is not to be replaced.
        SpecError: a plan that does not work (see `server_text`), or a key in the folder that others may read, or a
            folder that others may write to.
        OSError: the folder cannot be written.
    """
    names = [*systems]
    _check(servers, [NatsAccount(name, ()) for name in names])
    files = [folder / f"{server.name}.conf" for server in servers]
    if not force and (there := next((file for file in files if file.exists()), None)):
        raise FileExists(str(there))
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    _refuse_shared(folder)
    seeds = {(name, role): seed_file(folder, name, role) for name in names for role in UserRole}
    accounts = [
        NatsAccount(name, tuple(User(role, public_key(_kept(seeds[name, role], new_seed))) for role in UserRole))
        for name in names
    ]
    secret = _kept(folder / "routes.secret", lambda: secrets.token_hex(24)) if len(servers) > 1 else ""
    texts = [server_text(server, servers, accounts, secret) for server in servers]
    for file, text in zip(files, texts, strict=True):
        _write(file, text)
    return [*files, *seeds.values()]


def seed_file(folder: Path, system: str, role: UserRole) -> Path:
    """Where the key of a role in a system is kept."""
    return folder / f"{system}-{role.value}.nk"


def new_seed() -> str:
    """A new private key of a user.

    Raises:
        SpecError: the extra `nats` is not installed.
    """
    nkeys = _library()
    return bytes(nkeys.encode_seed(os.urandom(32), nkeys.PREFIX_BYTE_USER)).decode()


def public_key(seed: str) -> str:
    """The public key that belongs to a private one.

    Raises:
        SpecError: this is no private key of a user, which the text does not show; or the extra `nats` is not installed.
    """
    nkeys = _library()
    try:
        key = bytes(nkeys.from_seed(bytearray(seed.strip().encode())).public_key).decode()
    except (nkeys.NkeysError, ValueError):
        key = ""
    if not key.startswith("U"):
        raise SpecError("nkey", "this is no private key (seed) of a user, which begins with SU: write a new one")
    return key


def _library() -> ModuleType:
    try:
        return importlib.import_module("nkeys")
    except ImportError as error:
        raise SpecError("store", NEEDS) from error


def _refuse_shared(folder: Path) -> None:
    """Refuse a folder in which somebody else could put other files in the place of those that are written there.

    Raises:
        SpecError: it is somebody else's, or others may write to it.
    """
    info = folder.stat()
    if info.st_uid not in (0, os.geteuid()) or info.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        problem = f"somebody else may write to {folder}: make it your own, and chmod go-w {folder}"
        raise SpecError("nats config", problem)


def _kept(file: Path, make: Callable[[], str]) -> str:
    """What the file says; if it is not there, what is made is written to it."""
    if not file.exists():
        _write(file, make() + "\n")
    return read_private("nats config", file).decode().strip()


def _write(file: Path, text: str) -> None:
    """Write a file that nobody but its owner may read: all of it or nothing."""
    new = file.with_name(f"{file.name}-{secrets.token_hex(4)}")
    descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    try:
        with open(descriptor, "w", encoding="utf-8") as opened:
            opened.write(text)
        os.replace(new, file)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(new)
        raise


def _check(servers: Sequence[ServerPlan], accounts: Sequence[NatsAccount]) -> None:
    where = "nats config"
    if len(servers) not in (1, 3):
        raise SpecError(where, f"there are {len(servers)} servers: give 1, or 3, which go on without any one of them")
    for text in ("name", "client address", "cluster address"):
        found = [_identity(one, text) for one in servers]
        if len({*found}) < len(found):
            raise SpecError(where, f"two servers have one {text}: {', '.join(found)}")
    _check_ports(where, servers)
    for server in servers:
        check_name(where, server.name)
        check_host(where, server.host)
        if server.tls is None and not is_loopback(server.host):
            raise SpecError(
                where,
                f"the server {server.name} listens on {server.host}, which others reach: give it a certificate, its "
                "key and the certificate of who signed it, or let it listen on 127.0.0.1",
            )
    if not accounts:
        raise SpecError(where, "there is no system: name at least one")
    names = [check_name(where, account.system) for account in accounts]
    if len({*names}) < len(names) or "SYS" in names:
        raise SpecError(where, f"the systems must have different names, none of them SYS: {', '.join(names)}")


def _check_ports(where: str, servers: Sequence[ServerPlan]) -> None:
    """Refuse plans in which one port of a machine is to serve twice.

    Raises:
        SpecError: naming the port.
    """
    taken: dict[tuple[str, int], str] = {}
    for server in servers:
        uses = {"clients": server.port, "health checks": server.monitor_port}
        if len(servers) > 1:
            uses["the other servers"] = server.cluster_port
        for use, port in uses.items():
            this = f"{use} of {server.name}"
            other = taken.setdefault((server.host, port), this) if port else this
            if other != this:
                raise SpecError(where, f"port {port} of {server.host} is for {other} and for {this}: give another one")


def _identity(server: ServerPlan, text: str) -> str:
    match text:
        case "name":
            return server.name
        case "client address":
            return host_and_port(server.host, server.port)
        case _:
            return host_and_port(server.host, server.cluster_port)


def _account(account: NatsAccount) -> list[str]:
    lines = [f"  {_quoted(account.system)} {{", "    jetstream: enabled", "    users: ["]
    for user in account.users:
        allowed = permissions(account.system, user)
        lines += [
            f"      {{ nkey: {user.key}, permissions: {{ # {user.role.value}",
            f"        publish: {{ allow: {_listed(allowed.publish)} }},",
            f"        subscribe: {{ allow: {_listed(allowed.subscribe)} }} }} }}",
        ]
    return [*lines, "    ]", f'    imports: [{{ service: {{ account: SYS, subject: "{VARZ}" }} }}]', "  }"]


def _tls(server: ServerPlan, indent: str) -> list[str]:
    if server.tls is None:
        return []
    tls = server.tls
    return [
        f"{indent}tls {{",
        f"{indent}  cert_file: {_quoted(tls.certificate)}",
        f"{indent}  key_file: {_quoted(tls.key)}",
        f"{indent}  ca_file: {_quoted(tls.ca)}",
        f"{indent}  verify: true # whoever connects has a certificate, too",
        f"{indent}}}",
    ]


def host_and_port(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host and not host.startswith("[") else f"{host}:{port}"


def _listed(texts: Iterable[str]) -> str:
    return f"[{', '.join(map(_quoted, texts))}]"


def _quoted(text: str) -> str:
    """A text as a server's configuration has it.

    Raises:
        SpecError: it has a control character.
    """
    if not text.isprintable():
        raise SpecError("nats config", f"{text!r} has characters that cannot be printed: give another name or path")
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'
