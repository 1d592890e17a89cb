"""A connection to the servers of a system: encrypted where that is wanted, and with words for why it cannot be had.

`nats-py` encrypts if the server offers it, takes a refusal for an outage, and closes for good if a server that it was
connected to refuses it. So this client sends nothing in plain text that is to be encrypted, knows by which servers it
was refused and why, and connects again whatever ends a connection.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import ssl
from collections import Counter
from collections.abc import Coroutine, Generator
from typing import Any, Final, Literal, NamedTuple, TypeVar
from urllib.parse import ParseResult

import nats.errors
from nats.aio.client import Client, Srv
from nats.aio.transport import TcpTransport
from nats.js.errors import APIError, NoStreamResponseError
from nats.js.errors import Error as JetStreamError

from ..engine_thread import end_tasks
from ..ports import AccessRefused, Unanswered
from .access import NatsAccess, connect_options
from .server_file import VARZ
from .system_streams import SubjectNames

T = TypeVar("T")

ANSWER_SECONDS: Final = 2.0
"""How long one request waits for its answer."""
HANG_UPS: Final = 3
"""How often a server hangs up on a certificate before it is taken for a refusal: it may have ended just then."""
_PERMISSIONS: Final = "permissions violation"
_STALE: Final = "stale connection"
_LET_IN: Final = ("authorization violation", "authentication", "account")
"""What the error of a server has in it that knows who asks, and does not want them."""


class NotEncrypted(nats.errors.Error):
    """The server offers no encryption: nothing was sent."""


class EncryptedProtocol(asyncio.StreamReaderProtocol):
    """Has a connection closed when its other end is: one that is encrypted cannot be half open.

    That of asyncio asks for it to be left open, which asyncio then warns of at each end of a connection.
    """

    def eof_received(self) -> bool:
        """False: it is closed, too."""
        super().eof_received()
        return False


class EncryptedTransport(TcpTransport):
    """A connection that writes nothing before it is encrypted."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]  # nats-py gives it no types
        self._is_encrypted = False

    def __bool__(self) -> bool:
        """True: or the client would put one in its place that sends plain text."""
        return True

    async def connect(self, uri: ParseResult, buffer_size: int, connect_timeout: int) -> None:
        """Connect, in plain text so far; see `Transport`."""
        self._is_encrypted = False
        await super().connect(uri, buffer_size, connect_timeout)

    async def connect_tls(
        self, uri: str | ParseResult, ssl_context: ssl.SSLContext, buffer_size: int, connect_timeout: int
    ) -> None:
        """Encrypt the connection; see `Transport`."""
        assert self._io_writer is not None
        reader, loop = asyncio.StreamReader(), asyncio.get_running_loop()
        protocol = EncryptedProtocol(reader)
        host = uri if isinstance(uri, str) else uri.hostname
        started = loop.start_tls(self._io_writer.transport, protocol, ssl_context, server_hostname=host)
        transport = await asyncio.wait_for(started, connect_timeout)
        if transport is None:
            raise ConnectionResetError("the connection was closed while it was being encrypted")
        self._io_reader, self._io_writer = reader, asyncio.StreamWriter(transport, protocol, reader, loop)
        self._is_encrypted = True

    def write(self, payload: bytes) -> None:
        """Write if it is encrypted. Raises NotEncrypted."""
        self._refuse_plain()
        super().write(payload)  # type: ignore[no-untyped-call]  # nor this one

    def writelines(self, payload: list[bytes]) -> None:
        """Write if it is encrypted. Raises NotEncrypted."""
        self._refuse_plain()
        super().writelines(payload)  # type: ignore[no-untyped-call]  # nor this one

    def _refuse_plain(self) -> None:
        if not self._is_encrypted:
            raise NotEncrypted("nats: the server offers no TLS")


class ServerRefusal(NamedTuple):
    """Why a server does not want this program, and what to do."""

    problem: str
    remedy: str


class SystemClient(Client):
    """A client for one system.

    Attributes:
        refusals: by server, `host:port`, why it did not want this program when it was asked last.

    Args:
        access: where the servers are, and by which files this program is known to them.
        role: whose key it needs: "node" to run the system, "client" to send to it.
    """

    def __init__(self, access: NatsAccess, role: Literal["node", "client"] = "node") -> None:
        super().__init__()
        self.access = access
        self._role = role
        self._tried = ""
        self._failures: dict[str, str] = {}
        self.refusals: dict[str, ServerRefusal] = {}
        self._hung_up: Counter[str] = Counter()
        self._denied: list[str] = []
        self._is_settled = asyncio.Event()
        self._is_denied = asyncio.Event()

    # What others do with it

    async def enter(self, seconds: float) -> None:
        """Connect, and go on connecting from then on, whatever happens.

        Raises:
            SpecError: a file of secrets or certificates must not be used.
            AccessRefused: each server that answers refuses this program.
            Unanswered: none answers in time.
        """
        options: dict[str, Any] = {**connect_options(self.access), "error_cb": self._note}
        connecting = asyncio.ensure_future(self.connect(**options, reconnected_cb=self._reconnected))
        settled = asyncio.ensure_future(self._is_settled.wait())
        connecting.add_done_callback(self._connected)
        try:
            await asyncio.wait((settled,), timeout=seconds)
        finally:
            await end_tasks(connecting, settled)
            if not self.is_connected:
                await self.close()
        if self.is_connected:
            return
        if connecting.done() and not connecting.cancelled():
            connecting.result()
        for refusal in self.refusals.values():
            raise AccessRefused(self.access.name, *refusal)
        raise Unanswered(self.access.name, self.silence())

    async def probe(self, *, is_node: bool) -> None:
        """Whether this program's key is one for the system: of a node, or of one who may look.

        Raises:
            AccessRefused: it is not. Unanswered: the server does not say.
        """
        names = SubjectNames(self.access.system)
        wanted = (names.log, names.lease) if is_node else (names.lease,)
        with answering(self.access.name, self):
            asked = [await self.subscribe(subject) for subject in wanted]
            await self.flush(int(ANSWER_SECONDS))  # It overtakes the two above, which are in a queue.
            await self.flush(int(ANSWER_SECONDS))  # Before it answers this the server has refused them, if it does.
            for one in asked:
                await one.unsubscribe()
        denied = [subject for subject in wanted if any(f'"{subject.lower()}"' in one for one in self._denied)]
        if denied:
            system, key = self.access.system, self._key
            whose = "an observer" if names.lease not in denied else "a client, or of another system"
            what = "run" if is_node else "look at"
            raise AccessRefused(
                self.access.name,
                f"{key} may not {what} the system {system}: it is the key of {whose}",
                f"give the key of a node of {system}, such as nkey={system}-node.nk from `holdfast nats config`",
            )

    async def unless_denied(self, work: Coroutine[Any, Any, T]) -> T:
        """Do what the servers have to allow, and end when they say that they do not: else they only never answer.

        Raises:
            AccessRefused: something that this program has asked for is not allowed to it.
        """
        doing = asyncio.ensure_future(work)
        denied = asyncio.ensure_future(self._is_denied.wait())
        try:
            await asyncio.wait((doing, denied), return_when=asyncio.FIRST_COMPLETED)
            if doing.done():
                return doing.result()
        finally:
            await end_tasks(doing, denied)
        raise self._refused_here(self._denied[-1])

    def _refused_here(self, said: str) -> AccessRefused:
        """The servers know this program, and do not let it do what its role needs."""
        if self._role == "node":
            return AccessRefused(self.access.name, said, "give the key of a node, or let its user do that")
        system = self.access.system
        return AccessRefused(
            self.access.name,
            f"{self._key} may not send to the system {system}: it is the key of an observer, or of another system "
            f"({said})",
            f"give the key of a client or a node, such as nkey={system}-client.nk from `holdfast nats config`",
        )

    @property
    def _key(self) -> str:
        """What this program is known by."""
        return self.access.nkey or self.access.creds or "the user that needs no key"

    @property
    def denials(self) -> int:
        """How often the servers have said so far that something is not allowed to this program."""
        return len(self._denied)

    def refuse_denied(self, subject: str, since: int) -> None:
        """See whether an answer that did not come was a refusal: to wait for a server that refuses changes nothing.

        Args:
            subject: what was published to.
            since: `denials` before that.

        Raises:
            AccessRefused: it is not allowed to this program any more, or no server lets it in any more.
        """
        told = [one for one in self._denied[since:] if f'"{subject.lower()}"' in one]
        if told:
            remedy = "let the user of this program do that, or give the key of a node, and start it again"
            raise AccessRefused(self.access.name, told[-1], remedy)
        if not self.is_connected and len(self.refusals) >= len(self.access.servers):
            raise AccessRefused(self.access.name, *next(iter(self.refusals.values())))

    async def close(self) -> None:
        """Close the connection, if there ever was one to be made; a server that takes nothing is not waited for.

        What could not be sent goes with it. That is no error: whoever has asked for it gets no answer.
        """
        if not self.is_connected:  # It may be half-way to a connection, where nothing may be sent.
            self._pending, self._pending_data_size = [], 0
        try:
            if self._flush_queue is not None:  # Else the library asserts that there is.
                await super().close()
        except (NotEncrypted, OSError):
            pass
        finally:
            self._let_go()

    def _let_go(self) -> None:
        """Close the socket at once, with what was not sent."""
        transport = self._transport
        if isinstance(transport, TcpTransport) and transport._io_writer is not None:
            transport._io_writer.transport.abort()

    # What the library calls

    async def _connect_to_server(self, s: Srv) -> None:
        self._tried = f"{s.uri.hostname}:{s.uri.port}"
        if self.access.is_encrypted and not isinstance(self._transport, EncryptedTransport):
            self._transport = EncryptedTransport()
        if self._transport is not None:
            # Else the socket of an attempt that was refused stays open.
            self._transport.close()  # type: ignore[no-untyped-call]  # nats-py gives it no types
        await super()._connect_to_server(s)

    async def _attempt_reconnect(self) -> None:
        """Connect again; a connection whose other end is silent is let go of at once.

        Else it would be waited for until that is closed in good order: on a network that is cut 30 seconds with TLS,
        and as long as the kernel tries to send, a quarter of an hour, if anything was still to be sent.
        """
        self._let_go()
        await super()._attempt_reconnect()

    async def _process_err(self, err_msg: str) -> None:
        """What a server has said that is connected; all but a refusal of a single subject ends the connection."""
        if _STALE in err_msg or _PERMISSIONS in err_msg:
            await super()._process_err(err_msg)
            return
        error = nats.errors.Error(f"nats: {err_msg}")
        await self._note(error)
        await self._process_op_err(error)  # which connects again, where the library's own would close for good

    def _connected(self, done: asyncio.Future[None]) -> None:
        """Connecting has ended; without an error and a connection if the server has hung up, and it is tried again."""
        if self.is_connected:
            self._settle()
        elif done.cancelled() or done.exception() is not None:
            self._is_settled.set()

    async def _reconnected(self) -> None:
        self._settle()

    def _settle(self) -> None:
        """It is connected: what went wrong before does not count."""
        self.refusals.clear()
        self._failures.clear()
        self._hung_up.clear()
        self._is_settled.set()

    async def _note(self, error: Exception) -> None:
        """Take down why something has failed; whoever waits for an answer meanwhile gets `Unanswered`."""
        said = str(error).lower().removeprefix("nats: ")
        if _PERMISSIONS in said:
            if VARZ.lower() not in said:  # Not to see how servers are set up is a warning, see `server_check`.
                self._denied.append(f"the servers say: {said.strip()}")
                self._is_denied.set()
            return
        refusal = self._refusal(error, said)
        if refusal is not None:
            self.refusals[self._tried] = refusal
        else:
            self._failures[self._tried] = _failure(error, said)
        if self.refusals and not self.is_connected and len(self.refusals) >= len(self.access.servers):
            self._is_settled.set()

    def _refusal(self, error: Exception, said: str) -> ServerRefusal | None:
        where, access = f"the server {self._tried}", self.access
        if isinstance(error, NotEncrypted):
            return ServerRefusal(
                f"{where} offers no TLS, and what is sent there is to be encrypted (tls://, ca= or certificate=)",
                "give the server its certificate, as `holdfast nats config --certificate` does, or write nats://",
            )
        if isinstance(error, ssl.SSLCertVerificationError):
            return ServerRefusal(
                f"the certificate of {where} is not good: {error.verify_message}",
                "name who has signed it with ca=, and the server by a name that stands in it",
            )
        if self._server_info.get("tls_verify") and self._is_turned_away(error):
            if access.certificate is None:
                return ServerRefusal(f"{where} asks for a certificate", "give certificate= and key=")
            return ServerRefusal(
                f"{where} does not take the certificate {access.certificate}",
                "give one that is valid now and was signed by whom the server trusts (ca_file in its configuration)",
            )
        if any(one in said for one in _LET_IN):
            key = access.nkey or access.creds
            if key is None:
                return ServerRefusal(
                    f"{where} lets nobody in without a key ({said})",
                    f"give nkey=FILE, such as {access.system}-{self._role}.nk from `holdfast nats config`, "
                    "or creds=FILE",
                )
            return ServerRefusal(
                f"{where} does not know the key {key} ({said})",
                "give one that stands in its configuration; if it does, have the server reload that",
            )
        return None

    def _is_turned_away(self, error: Exception) -> bool:
        """Whether a server that asks for certificates does not want this one: some only hang up, again and again."""
        if isinstance(error, (ConnectionResetError, nats.errors.UnexpectedEOF)):
            self._hung_up[self._tried] += 1
            return self._hung_up[self._tried] >= HANG_UPS
        return isinstance(error, ssl.SSLError)

    def silence(self) -> str:
        """Why nobody answers, in words."""
        servers = ", ".join(one.partition("://")[2] for one in self.access.servers)
        whys = dict.fromkeys(self._failures.values())
        why = "; ".join(whys) if whys else "they say nothing"
        return f"no server answers at {servers} ({why}): start them, or name others"


def _failure(error: Exception, said: str) -> str:
    match error:
        case ConnectionRefusedError():
            return "nobody listens there"
        case socket.gaierror():
            return "there is no such host"
        case TimeoutError():
            return "no answer in time"
        case _:
            return said or type(error).__name__


@contextlib.contextmanager
def answering(name: str, client: Client) -> Generator[None, None, None]:
    """Whatever means that nobody knows is `Unanswered`, with the server that was asked, or all if none is there.

    Raises:
        Unanswered: the server has not answered, or has answered that it cannot do that now.
    """
    try:
        yield
    except (nats.errors.Error, JetStreamError, TimeoutError, OSError) as error:
        raise Unanswered(name, why_unanswered(error, client)) from error


def why_unanswered(error: Exception, client: Client) -> str:
    """Why there was no answer, and which server has not given one."""
    if isinstance(client, SystemClient) and not client.is_connected:
        return client.silence()
    url = client.connected_url
    where = "the server" if url is None else f"the server {url.hostname}:{url.port}"
    if isinstance(error, NoStreamResponseError):
        return f"{where} says that nobody keeps this stream now"
    if isinstance(error, TimeoutError):
        return f"{where} has not answered in time; it may wait for others to elect a leader"
    said = error.description if isinstance(error, APIError) else str(error)
    return f"{where} says: {said or type(error).__name__}"
