"""How a system gets at its servers: what `store="nats://..."` and the settings say, checked."""

from __future__ import annotations

import os
import re
import ssl
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, TypedDict
from urllib.parse import parse_qsl, unquote, urlsplit

import msgspec

from ...actors.errors import SpecError
from ...actors.streams import is_loopback
from .private_files import read_private
from .server_file import check_host, check_name, inbox_of, public_key

DEFAULT_PORT: Final = 4222
SETTINGS: Final = ("ca", "certificate", "creds", "insecure", "key", "nkey", "replicas")
"""What may stand behind the question mark of a store, and in the settings."""
_SEED: Final = re.compile(r"S[A-Z2-7]{50,}")
_CREDENTIALS: Final = {"BEGIN NATS USER JWT": "user", "BEGIN USER NKEY SEED": "private key"}
"""Lines of a file of credentials, and what stands in the one behind each."""
_WHERE: Final = "store"
_EXAMPLE: Final = "nats://HOST[:PORT][,HOST,HOST]/SYSTEM"
_BOOLS: Final = {"": True, "1": True, "true": True, "yes": True, "0": False, "false": False, "no": False}


class NatsAccess(msgspec.Struct, frozen=True, kw_only=True):
    """Where the servers are, and by which files this process is known to them. It holds paths, never secrets.

    Attributes:
        servers: `nats://host:port` or `tls://host:port`, one for each.
        system: the system that is kept there: its account and part of every subject.
        replicas: on how many servers each record is: 1 or 3.
        creds: a file with a user's JWT and private key, as operators of NATS hand them out.
        nkey: a file with a private key alone, as `holdfast nats config` writes it.
        ca: a file with the certificates of who signs those of the servers.
        certificate: a file with a certificate that the servers ask for.
        key: a file with the private key of that certificate.
        insecure: whether servers on other machines may be used without TLS.
    """

    servers: tuple[str, ...]
    system: str
    replicas: int = 1
    creds: str | None = None
    nkey: str | None = None
    ca: str | None = None
    certificate: str | None = None
    key: str | None = None
    insecure: bool = False

    @property
    def name(self) -> str:
        """What errors call the store: its servers and its system, without the files of secrets."""
        scheme = self.servers[0].partition("://")[0]
        return f"{scheme}://{','.join(one.partition('://')[2] for one in self.servers)}/{self.system}"

    @property
    def is_encrypted(self) -> bool:
        """Whether what is sent to the servers is."""
        return self.ca is not None or any(one.startswith("tls:") for one in self.servers)


class ConnectOptions(TypedDict, total=False):
    """The arguments of `nats.connect` that an access gives."""

    servers: list[str]
    name: str
    allow_reconnect: bool
    max_reconnect_attempts: int
    reconnect_time_wait: Any  # nats-py says int, and sleeps for it: a fraction of a second is right
    connect_timeout: int
    ping_interval: int
    max_outstanding_pings: int
    inbox_prefix: str
    user_credentials: str
    nkeys_seed: str
    tls: ssl.SSLContext


def access_of(store: str, settings: Mapping[str, str | bool | int] | None = None) -> NatsAccess:
    """What a store's address says, and the settings beside it; the address goes first.

    Args:
        store: `nats://host[:port],host,host/system?name=value&...`; `tls://` where the servers have certificates.
        settings: values of SETTINGS, by name: from `holdfast.toml`, say.

    Raises:
        SpecError: the address or a setting is not valid, a file of secrets may be used by others, or servers on other
            machines would be used without TLS.
    """
    scheme, colon, rest = store.partition("://")
    if not colon or scheme not in ("nats", "tls"):
        raise SpecError(_WHERE, f"{_hidden(store)!r} must be {_EXAMPLE}, or the same with tls://")
    try:
        parts = urlsplit(f"//{rest}")
    except ValueError as error:  # brackets that do not close
        raise SpecError(_WHERE, f"{_hidden(store)!r} is no address: write {_EXAMPLE}") from error
    if parts.fragment or "@" in parts.netloc:
        raise SpecError(
            _WHERE, "an address has no user, no password and no #: name a file, ?nkey=/path or ?creds=/path"
        )
    system = unquote(parts.path).strip("/")
    if not system:
        raise SpecError(_WHERE, f"{_hidden(store)!r} names no system: write {_EXAMPLE}")
    servers = tuple(f"{scheme}://{_address(one)}" for one in parts.netloc.split(","))
    if len({*servers}) < len(servers):
        raise SpecError(_WHERE, f"a server is named twice: {', '.join(servers)}")
    said = parse_qsl(parts.query, keep_blank_values=True)
    if twice := [name for number, (name, _) in enumerate(said) if name in dict(said[:number])]:
        raise SpecError(_WHERE, f"{twice[0]} is said twice: say it once")
    told = {**(settings or {}), **dict(said)}
    if unknown := sorted(told.keys() - {*SETTINGS}):
        raise SpecError(_WHERE, f"there is no setting {unknown[0]!r}: there are {', '.join(SETTINGS)}")
    access = NatsAccess(
        servers=servers,
        system=check_name(_WHERE, system),
        replicas=_replicas(told.get("replicas"), len(servers)),
        insecure=_bool(told.get("insecure", False)),
        **{name: _path(name, told.get(name)) for name in ("creds", "nkey", "ca", "certificate", "key")},
    )
    _check(access)
    return access


def connect_options(access: NatsAccess) -> ConnectOptions:
    """The arguments for `nats.connect`: it never gives up, and notices within four seconds that a server is silent.

    Raises:
        SpecError: a file is not there, is no key or no certificate, or others may use a file of secrets.
    """
    options = ConnectOptions(
        servers=[*access.servers],
        name=f"holdfast {access.system} {os.getpid()}",
        allow_reconnect=True,
        max_reconnect_attempts=-1,
        reconnect_time_wait=0.1,
        connect_timeout=2,
        ping_interval=2,
        max_outstanding_pings=2,
    )
    if access.creds is not None:
        _check_credentials(Path(access.creds))
        options["user_credentials"] = access.creds
    elif access.nkey is not None:
        seed = read_private(_WHERE, Path(access.nkey)).decode("ascii", "replace")
        options["inbox_prefix"] = inbox_of(public_key(seed))
        options["nkeys_seed"] = access.nkey
    if access.is_encrypted:
        options["tls"] = _tls(access)
    return options


def _check_credentials(file: Path) -> None:
    """Refuse a file in which the library would not find what it looks for.

    Raises:
        SpecError: naming the file, and what it lacks.
    """
    lines = read_private(_WHERE, file).decode("ascii", "replace").splitlines()
    for begin, what in _CREDENTIALS.items():
        if not any(begin in line and after.strip() for line, after in pairwise(lines)):
            alone = _SEED.fullmatch("".join(lines).strip()) is not None
            hint = "; a private key alone is given as nkey=" if alone else ""
            raise SpecError(_WHERE, f"creds: there is no {what} in {file}, after a line with {begin!r}{hint}")
    seed = next(after for line, after in pairwise(lines) if "BEGIN USER NKEY SEED" in line)
    public_key(seed)


def _tls(access: NatsAccess) -> ssl.SSLContext:
    try:
        context = ssl.create_default_context(cafile=access.ca)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        if access.certificate is not None and access.key is not None:
            read_private(_WHERE, Path(access.key))
            # An empty password, or OpenSSL would ask for one at the terminal.
            context.load_cert_chain(access.certificate, access.key, password="")
    except (OSError, ssl.SSLError) as error:
        files = ", ".join(one for one in (access.ca, access.certificate, access.key) if one is not None)
        raise SpecError(_WHERE, f"the certificates ({files}) cannot be read: {error}") from error
    return context


def _check(access: NatsAccess) -> None:
    if access.creds is not None and access.nkey is not None:
        raise SpecError(_WHERE, "both creds and nkey are given: give the file of one")
    if (access.certificate is None) != (access.key is None):
        raise SpecError(_WHERE, "a certificate and its key belong together: give both or none")
    for file in (access.creds, access.nkey, access.key):
        if file is not None:
            read_private(_WHERE, Path(file))
    far = [one for one in access.servers if not is_loopback(urlsplit(one).hostname or "")]
    if far and not access.is_encrypted and not access.insecure:
        raise SpecError(
            _WHERE,
            f"{far[0]} is another machine, and what is sent there would not be encrypted: write tls:// and give ca=, "
            "certificate= and key=, or insecure=true where the network itself is trusted",
        )


def _address(server: str) -> str:
    """Host and port of a server.

    Raises:
        SpecError: there is no host, or the port is no number.
    """
    parts = urlsplit(f"//{server}")
    try:
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise SpecError(_WHERE, f"the server {server!r} has no valid port: write HOST:PORT") from error
    if not host:
        raise SpecError(_WHERE, f"a server has no host: write {_EXAMPLE}")
    check_host(_WHERE, host)
    return f"[{host}]:{port or DEFAULT_PORT}" if ":" in host else f"{host}:{port or DEFAULT_PORT}"


def _replicas(told: str | bool | int | None, servers: int) -> int:
    if told is None:
        return 3 if servers >= 3 else 1
    if str(told) not in ("1", "3"):
        raise SpecError(_WHERE, f"replicas must be 1 or 3, not {told!r}: with 2, the loss of either stops both")
    return int(told)


def _bool(told: str | bool | int) -> bool:
    found = _BOOLS.get(str(told).lower())
    if found is None:
        raise SpecError(_WHERE, f"insecure must be true or false, not {told!r}")
    return found


def _path(name: str, told: str | bool | int | None) -> str | None:
    if told is None:
        return None
    if not isinstance(told, str) or not told:
        raise SpecError(_WHERE, f"{name} must be the path of a file, not {told!r}")
    if _SEED.fullmatch(told):
        raise SpecError(
            _WHERE, f"{name} must be the path of a file; this is a private key: make a new one, and keep it in a file"
        )
    return os.path.abspath(os.path.expanduser(told))


def _hidden(store: str) -> str:
    """An address without what may be a password."""
    _, at, tail = store.rpartition("@")
    return f"...@{tail}" if at else store
