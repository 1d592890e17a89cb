"""Who may use the page: tokens and roles, the cookie they are exchanged for, and from where a request may come."""

from __future__ import annotations

import dataclasses
import hmac
import os
import secrets
import stat
import time
from collections import OrderedDict
from collections.abc import Iterable
from pathlib import Path
from typing import Final, Literal
from urllib.parse import urlsplit

from starlette.requests import HTTPConnection

from ...actors.errors import HoldfastError, SpecError

Role = Literal["read", "operate"]
"""What somebody may do: look, or change the system as well."""
SHORTEST: Final = 16
"""Characters that a token must have."""
TOKEN_BYTES: Final = 32
LASTS: Final = 12 * 3600.0
"""Seconds after which one has to log in again."""
MOST_SESSIONS: Final = 200
"""Browsers that are logged in; beyond, whoever has asked for nothing for longest has to log in again."""
MOST_WRONG: Final = 10
"""Wrong tokens within `WRONG_PERIOD`; then nobody logs in until it is over."""
WRONG_PERIOD: Final = 60.0
LOOPBACK: Final = ("127.0.0.1", "localhost", "[::1]")
"""Hosts whose names are always good: nobody else's page can be called so."""
CSRF_HEADER: Final = "x-holdfast-csrf"


class NotAllowed(HoldfastError, text="{problem}"):
    """The dashboard does not answer this request: who asks, or the page that asks, has no right to."""

    status: int
    problem: str


def token_of(given: str | Path, name: str) -> str:
    """A token as it was given, or that of a file, which is made with a new token in it if it is not there.

    Raises:
        SpecError: it is too short, or others may read or write the file.
    """
    token = given if isinstance(given, str) else _in_file(given, name)
    if len(token) < SHORTEST or not token.isascii() or not token.isprintable() or " " in token:
        raise SpecError("dashboard", f"{name} must be a token of {SHORTEST} printable signs at least, without spaces")
    return token


def _in_file(path: Path, name: str) -> str:
    try:
        with open(path, "x", encoding="ascii", opener=lambda file, flags: os.open(file, flags, 0o600)) as file:
            token = secrets.token_urlsafe(TOKEN_BYTES)
            file.write(f"{token}\n")
            return token
    except FileExistsError:
        pass  # Made before, by this program or by its owner.
    except OSError as error:
        raise SpecError("dashboard", f"{name}: {path} cannot be made: {error.strerror or error}") from error
    try:
        with open(path, encoding="ascii", opener=lambda file, flags: os.open(file, flags | os.O_NOFOLLOW)) as file:
            info = os.fstat(file.fileno())
            if info.st_uid != os.geteuid() or info.st_mode & (stat.S_IRWXG | stat.S_IRWXO):
                mode = stat.S_IMODE(info.st_mode)
                raise SpecError("dashboard", f"{name}: others may read {path} (mode {mode:04o}): chmod 600, new token")
            return file.read(4096).strip()
    except (OSError, UnicodeDecodeError) as error:
        raise SpecError("dashboard", f"{name}: {path} cannot be read: {error}") from error


@dataclasses.dataclass(slots=True)
class Login:
    """A browser that has shown a token."""

    role: Role
    csrf: str
    until: float


class Access:
    """Knows the tokens, who has logged in, and the names under which the page may be asked for.

    Args:
        tokens: by role; at least one.
        hosts: names of hosts, with their port if that is not to be any, beside those of the loopback.
    """

    def __init__(self, tokens: dict[Role, str], hosts: Iterable[str] = ()) -> None:
        if not tokens:
            raise SpecError("dashboard", "give operators= or readers=: a token, or the path of a file for one")
        if len(set(tokens.values())) < len(tokens):
            raise SpecError("dashboard", "operators and readers need different tokens")
        self._tokens = tokens
        self._hosts = frozenset({*LOOPBACK, *(host.lower() for host in hosts)})
        self._logins: OrderedDict[str, Login] = OrderedDict()
        self._wrong: list[float] = []
        self.cookie = f"holdfast-{secrets.token_hex(4)}"
        """The name of the cookie: browsers do not tell the ports of one host apart, so each dashboard has its own."""

    def check_host(self, connection: HTTPConnection) -> str:
        """Refuse what was asked for under a name that is not ours (DNS rebinding). Raises NotAllowed."""
        host = connection.headers.get("host", "").lower()
        if host not in self._hosts and _without_port(host) not in self._hosts:
            told = f"this dashboard is not called {host[:100]!r}: give hosts=[...] if it is to be"
            raise NotAllowed(421, told)
        return host

    def check_origin(self, connection: HTTPConnection) -> None:
        """Refuse what another page has sent. Raises NotAllowed: that, or the host is not ours."""
        host = self.check_host(connection)
        origin = connection.headers.get("origin")
        if origin is not None and urlsplit(origin).netloc.lower() != host:
            raise NotAllowed(403, f"a page of {origin[:100]!r} may not ask here")
        if connection.headers.get("sec-fetch-site", "none") not in ("same-origin", "none"):
            raise NotAllowed(403, "another page may not ask here")

    def log_in(self, token: str) -> tuple[str, Login]:
        """Exchange a token for the value of a cookie.

        Raises:
            NotAllowed: it is no token, or too many were wrong a moment ago.
        """
        now = time.monotonic()
        given = token.encode()
        roles: list[Role] = [role for role, one in self._tokens.items() if hmac.compare_digest(one.encode(), given)]
        if not roles:  # Whoever has a right one is let in, whatever others have tried.
            self._wrong = [at for at in self._wrong if now - at < WRONG_PERIOD]
            if len(self._wrong) >= MOST_WRONG:
                raise NotAllowed(429, f"too many wrong tokens: wait {WRONG_PERIOD:g} s")
            self._wrong.append(now)
            raise NotAllowed(401, "this is no token of this dashboard")
        key = secrets.token_urlsafe(TOKEN_BYTES)
        login = self._logins[key] = Login(roles[0], secrets.token_urlsafe(TOKEN_BYTES), now + LASTS)
        while len(self._logins) > MOST_SESSIONS:
            self._logins.popitem(last=False)
        return key, login

    def log_out(self, connection: HTTPConnection) -> None:
        """Forget a browser."""
        self._logins.pop(connection.cookies.get(self.cookie, ""), None)

    def is_known(self, connection: HTTPConnection) -> bool:
        """Whether somebody has logged in, and the login is not over."""
        login = self._logins.get(connection.cookies.get(self.cookie, ""))
        return login is not None and time.monotonic() <= login.until

    def login_of(self, connection: HTTPConnection) -> Login:
        """Who asks. Raises NotAllowed: somebody who has not logged in, or whose login is over."""
        key = connection.cookies.get(self.cookie, "")
        if not self.is_known(connection):
            self._logins.pop(key, None)
            raise NotAllowed(401, "log in with a token: this page was opened without one, or the program began anew")
        self._logins.move_to_end(key)
        return self._logins[key]

    def check_page(self, connection: HTTPConnection, login: Login) -> None:
        """Refuse a request that the page itself has not made. Raises NotAllowed."""
        if not hmac.compare_digest(connection.headers.get(CSRF_HEADER, "").encode(), login.csrf.encode()):
            raise NotAllowed(403, "this request was not made by the page: load it again")


def check_role(login: Login, needed: Role) -> None:
    """Refuse what a role may not do. Raises NotAllowed."""
    if needed == "operate" and login.role != "operate":
        raise NotAllowed(403, "this token may look only: log in with one for operators")


def _without_port(host: str) -> str:
    name, colon, port = host.rpartition(":")
    return name if colon and port.isdecimal() else host
