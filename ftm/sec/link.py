"""A secured link of one participant to others: sessions made when they are needed, frames until they are answered.

Whoever sits between may alter, drop, replay and forge: what is refused or lost is sealed anew and sent again, and what
comes twice is handled once, in order. A session is made for each pair of lives and each epoch, and when one is over.
"""

from __future__ import annotations

import asyncio
import contextvars
import hashlib
import os
import tempfile
import time
from collections import Counter, deque
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from ...actors.errors import AskTimeout, HoldfastError
from ...actors.message import Message, message_name
from ..sealed import (
    ORDERS,
    TELLS,
    Agree,
    Back,
    Call,
    FrameRefused,
    Greet,
    Handle,
    LinkLost,
    Part,
    Reach,
    Refused,
    Sealed,
    Still,
)
from .authority import Enrol, GetCertificate, GetRevocations, GetRoot, Revoke
from .certificates import MOST_NAME, Trust, about, make_request, public_of
from .errors import (
    CLOSED,
    MALFORMED,
    REPLAYED,
    UNTRUSTED,
    WRONG_PEER,
    WRONG_SESSION,
    EnrolmentRefused,
    NoCertificate,
    Rejected,
)
from .handshake import Participant, Response
from .keys import Secret, SigningKey, raw_public
from .session import HEAD, Limits, Session

if TYPE_CHECKING:
    from ...actors.node import Node
    from ..mechanisms.sec import SEC

CALL, BACK = b"call", b"back"
PLAIN, OUT_OF_ORDER = "plain", "out_of_order"
FIRST_WAIT, LONGEST_WAIT = 0.5, 8.0
"""Seconds until a frame that is not answered is sent again; doubled each time."""
FIRST_PAUSE, LONGEST_PAUSE = 0.002, 0.25
"""Seconds until a frame that was refused is sent again; the same."""
MOST_BYTES = 1_000_000
"""Of messages in one frame, if there are several."""
MOST_REPLICAS = 64
MOST_RESPONSES = 32
"""Hand-shakes that others have begun, and not ended: the oldest are forgotten."""
AUTHORITY_WITHIN = 5.0
"""Seconds in which the authority has to answer."""
RENEWED: Final = 0.5
"""Part of a certificate's time that is left when a new one is fetched."""


def certified(path: str) -> str:
    """The name of a participant in certificates: its address; of a long one, its end and a digest."""
    if len(path) <= MOST_NAME:
        return path
    digest = hashlib.sha256(path.encode()).hexdigest()[:32]
    return f"{digest}…{path[-(MOST_NAME - 33) :]}"


def key_file(folder: str, path: str) -> Path:
    """Where the key of a participant is."""
    return Path(folder) / f"{hashlib.sha256(path.encode()).hexdigest()[:32]}.key"


def root_file(folder: str, authority: str) -> Path:
    """Where the authority's certificate is: its public half, which nobody else may exchange."""
    return Path(folder) / f"{hashlib.sha256(authority.encode()).hexdigest()[:32]}.root"


class Stream:
    """Numbered calls of one kind, to or from one partner."""

    __slots__ = ("answers", "floor", "next", "open")

    def __init__(self) -> None:
        self.next = self.floor = 0
        self.open: set[int] = set()  # outward: those without an answer
        self.answers: dict[int, asyncio.Future[Back]] = {}  # inward


class Partner(Secret):
    """Another participant, as this one knows it."""

    __slots__ = ("inward", "life", "lock", "name", "outward", "pump", "queue", "session")

    def __init__(self, path: str) -> None:
        self.name = certified(path)
        self.session: Session | None = None
        self.lock = asyncio.Lock()
        self.outward: dict[str, Stream] = {}
        self.inward: dict[str, Stream] = {}
        self.life = -1  # whose calls those are
        self.queue: deque[tuple[Part, Reach, Still]] = deque()
        self.pump: asyncio.Task[None] | None = None


class Link(Secret):
    """One end of secured links.

    Args:
        node: of this process.
        address: the protected actor's.
        path: this participant's.
        mechanism: its settings.
        epoch: the present one.
        enrols: of whom this one orders certificates; None: it is enrolled by another.
    """

    def __init__(
        self,
        node: Node,
        address: str,
        path: str,
        mechanism: SEC,
        epoch: Callable[[], int],
        enrols: Callable[[], list[str]] | None = None,
    ) -> None:
        self.mechanism, self.path = mechanism, path
        self._node, self._address, self._epoch, self._enrols = node, address, epoch, enrols
        self.rejected: Counter[str] = Counter()
        self._proxy = certified(f"{address}/ftm/proxy")
        self._replicas = frozenset(certified(f"{address}/ftm/r{number}") for number in range(1, MOST_REPLICAS + 1))
        self._me: Participant | None = None
        self._lock = asyncio.Lock()
        self._enrolled: set[str] = set()
        self._partners: dict[str, Partner] = {}
        self._sessions: dict[bytes, Session] = {}
        self._responses: dict[bytes, Response] = {}
        self._is_closed = False

    # -- who we are -------------------------------------------------------------------------------------------------

    async def ready(self) -> None:
        """Get all certificates.

        Raises:
            HoldfastError: which cannot be had, and why.
        """
        await self._identity()

    async def _identity(self) -> Participant:
        async with self._lock:
            if self._me is None or self._is_due(self._me.certificate):
                self._me = await self._identify()
            me = self._me
        try:
            me.take_list(await self._authority(GetRevocations()))
        except Rejected as error:
            self._refuse(error.reason)
        except HoldfastError:
            pass  # It is between two lives: what was revoked before is known.
        me.raise_epoch(self._epoch())
        return me

    async def _identify(self) -> Participant:
        settings, old = self.mechanism, self._me
        if self._enrols is not None:
            root = await self._authority(GetRoot())
            self._check_root(root)
            write_whole(root_file(settings.keys, settings.authority), root)
            for path in (self.path, *self._enrols()):
                await self._enrol(path)
        else:
            root = root_file(settings.keys, settings.authority).read_bytes()
            self._check_root(root)
        key = SigningKey.from_file(key_file(settings.keys, self.path))
        certificate = await self._authority(GetCertificate(certified(self.path)))
        limits = Limits(settings.rotate_messages, settings.rotate_seconds, lifetime=settings.lifetime)
        life = time.monotonic_ns() if old is None else old.incarnation
        trust = Trust(root)
        me = Participant(
            key, certificate, trust, incarnation=life, epoch=self._epoch(), suites=settings.suites, limits=limits
        )
        me.rejected = self.rejected
        return me

    def _check_root(self, root: bytes) -> None:
        """The authority must be the one that everybody knows (A70)."""
        wanted = self.mechanism.fingerprint
        if wanted and hashlib.sha256(public_of(root)).hexdigest()[: len(wanted)] != wanted:
            raise Rejected(UNTRUSTED, "the certificate of the authority")

    def _is_due(self, certificate: bytes) -> bool:
        return about(certificate)[1] - time.time() < self.mechanism.renew_days * 86400.0

    async def _enrol(self, path: str) -> None:
        """Order a certificate; once, and when its time is nearly over: one that was revoked stays so."""
        name, key = certified(path), SigningKey.from_file(key_file(self.mechanism.keys, path))
        try:
            certificate = await self._authority(GetCertificate(name))
            if public_of(certificate) == raw_public(key.public) and not self._is_due(certificate):
                self._enrolled.add(name)
                return
        except NoCertificate:
            if name in self._enrolled:
                return
        request = make_request(key, name)
        try:
            await self._authority(Enrol(request))
        except EnrolmentRefused:
            if not self.mechanism.is_per_start or name in self._enrolled:
                raise
            await self._authority(Revoke(name))  # It was that of an earlier start.
            await self._authority(Enrol(request))
        self._enrolled.add(name)

    async def _authority(self, message: Message[Any]) -> Any:
        return await self._node.cell_at(self.mechanism.authority).ref.ask(message, timeout=AUTHORITY_WITHIN)

    # -- hand-shakes ------------------------------------------------------------------------------------------------

    def _partner(self, path: str) -> Partner:
        name = certified(path)
        found = self._partners.get(name)
        if found is None:
            found = self._partners[name] = Partner(path)
        return found

    async def _session(self, partner: Partner, path: str, reach: Reach) -> Session:
        """A session of this epoch and these lives."""
        epoch = self._epoch()
        async with partner.lock:
            session = partner.session
            if session is not None and session.is_open and session.epoch == epoch:
                return session
            if self._enrols is not None and partner.name not in self._enrolled:
                await self._enrol(path)
            me = await self._identity()
            begun = me.begin(partner.name)
            answer = await reach(Greet(begun.hello), FIRST_WAIT)
            session, finish = begun.finish(answer)
            await reach(Agree(digest_of(begun.hello), finish), FIRST_WAIT)
            self._keep(partner, session)
            return session

    def _keep(self, partner: Partner, session: Session) -> None:
        partner.session = session
        self._sessions = {key: one for key, one in self._sessions.items() if one.is_open}
        self._sessions[session.number] = session

    async def greet(self, hello: bytes) -> bytes:
        """Answer a hello. Nothing is believed yet.

        Raises:
            Refused: it is nobody's whom we know.
        """
        self._check_open()
        try:
            me = await self._identity()
            try:
                response = me.answer(hello)
                self._check_peer(response.peer.name)
            except Rejected as error:
                if error.reason != UNTRUSTED or not self._has_other_root(me):
                    raise
                self._me = None  # The authority has begun a new life, with another key.
                response = (await self._identity()).answer(hello)
                self._check_peer(response.peer.name)
        except Rejected as error:
            raise self._refused(error.reason) from None
        except (HoldfastError, OSError) as error:
            raise Refused(path=self.path, reason=f"no certificate: {error}") from None
        while len(self._responses) >= MOST_RESPONSES:
            del self._responses[next(iter(self._responses))]
        self._responses[digest_of(hello)] = response
        return response.answer

    def _check_peer(self, name: str) -> None:
        """Who has a certificate may still have no business here."""
        if name not in self._replicas and (self._enrols is not None or name != self._proxy):
            self.rejected[WRONG_PEER] += 1
            raise Rejected(WRONG_PEER, f"a hand-shake of {name!r}")

    def _may(self, name: str, stream: str) -> bool:
        """Whether this participant may say such things: orders and requests are the proxy's."""
        if self._enrols is not None:
            return name in self._replicas and stream == TELLS
        return name == self._proxy if stream in (TELLS, ORDERS) else name in self._replicas

    def _has_other_root(self, me: Participant) -> bool:
        file = root_file(self.mechanism.keys, self.mechanism.authority)
        return self._enrols is None and file.read_bytes() != me.trust.root

    async def agree(self, hello: bytes, finish: bytes) -> None:
        """Complete a hand-shake that another has begun.

        Raises:
            Refused: it is not the one it says.
        """
        self._check_open()
        response = self._responses.pop(hello, None)
        if response is None:
            raise self._refused(CLOSED, counts=True)
        try:
            session = response.complete(finish)
        except Rejected as error:
            raise self._refused(error.reason) from None
        name = session.peer.name
        partner = self._partners.get(name)
        if partner is None:
            partner = self._partners[name] = Partner(name)
        self._keep(partner, session)

    # -- out --------------------------------------------------------------------------------------------------------

    def tell(self, path: str, message: Message[Any], reach: Reach, still: Still) -> None:
        """Bring a message there, once, behind those that were told before; `still` says whether it is wanted."""
        if self._is_closed:
            return
        partner = self._partner(path)
        partner.queue.append((self._part(message), reach, still))
        if partner.pump is None:
            partner.pump = self._node.loop.create_task(self._send_all(partner, path), context=contextvars.Context())

    def _part(self, message: Message[Any]) -> Part:
        return Part(message_name(type(message)), self._node.codec.encode(message, self._address))

    async def _send_all(self, partner: Partner, path: str) -> None:
        queue = partner.queue
        try:
            while queue and not self._is_closed:
                part, reach, still = queue.popleft()
                parts, size = [part], len(part.body)
                while queue and size + len(queue[0][0].body) < MOST_BYTES:
                    part, reach, still = queue.popleft()
                    parts.append(part)
                    size += len(part.body)
                try:
                    await self._call(partner, path, TELLS, parts, reach, still)
                except LinkLost:
                    continue
        finally:
            partner.pump = None

    async def call(
        self, path: str, stream: str, part: Part, reach: Reach, still: Still, epoch: int = -1, config: int = -1
    ) -> Back:
        """Ask something until the answer comes.

        Raises:
            LinkLost: nobody waits for it any longer.
        """
        return await self._call(self._partner(path), path, stream, [part], reach, still, epoch, config)

    async def _call(
        self,
        partner: Partner,
        path: str,
        name: str,
        parts: list[Part],
        reach: Reach,
        still: Still,
        epoch: int = -1,
        config: int = -1,
    ) -> Back:
        stream = partner.outward.setdefault(name, Stream())
        number, stream.next = stream.next, stream.next + 1
        stream.open.add(number)
        wait, pause = FIRST_WAIT, FIRST_PAUSE
        try:
            while still() and not self._is_closed:
                session: Session | None = None
                try:
                    session = await self._session(partner, path, reach)
                    text = msgspec.msgpack.encode(Call(name, number, min(stream.open), parts, epoch, config))
                    reply = await reach(Sealed(session.seal(text, CALL)), wait)
                    opened = session.open(reply, BACK + number.to_bytes(8, "big"))
                    return msgspec.msgpack.decode(opened, type=Back)
                except AskTimeout:
                    wait = min(2 * wait, LONGEST_WAIT)
                    continue
                except Rejected as error:
                    self._refuse(error.reason)
                except Refused as no:
                    if no.reason != OUT_OF_ORDER and session is not None and partner.session is session:
                        partner.session = None  # The other end may have none.
                except HoldfastError:
                    pass  # It is between two lives, or at its end, which whoever asks is told.
                await asyncio.sleep(pause)
                pause = min(2 * pause, LONGEST_PAUSE)
            raise LinkLost(path)
        finally:
            stream.open.discard(number)

    # -- in ---------------------------------------------------------------------------------------------------------

    async def take(self, frame: bytes, handle: Handle) -> bytes:
        """Open a frame, and have what is in it done once; the reply is sealed.

        Raises:
            Refused: it is not from whom it says, was here before, or its time has not come.
        """
        self._check_open()
        me = self._me
        if me is not None:
            me.raise_epoch(self._epoch())
        session = self._sessions.get(bytes(frame[1:9])) if len(frame) >= HEAD.size else None
        if session is None:
            raise self._refused(WRONG_SESSION, counts=True)
        try:
            call = msgspec.msgpack.decode(session.open(frame, CALL), type=Call)
        except Rejected as error:
            raise self._refused(error.reason) from None
        except msgspec.MsgspecError:
            raise self._refused(MALFORMED, counts=True) from None
        if not self._may(session.peer.name, call.stream):
            raise self._refused(WRONG_PEER, counts=True)
        back = await self._once(session, call, handle)
        try:
            return session.seal(msgspec.msgpack.encode(back), BACK + call.number.to_bytes(8, "big"))
        except Rejected as error:  # The epoch has ended meanwhile: it is asked again.
            raise Refused(path=self.path, reason=error.reason) from None

    async def _once(self, session: Session, call: Call, handle: Handle) -> Back:
        partner = self._partners[session.peer.name]
        if session.incarnation != partner.life:
            partner.life, partner.inward = session.incarnation, {}
        stream = partner.inward.setdefault(call.stream, Stream())
        known = stream.answers.get(call.number)
        if known is not None:
            return await asyncio.shield(known)
        if call.number < stream.floor:
            raise self._refused(REPLAYED, counts=True)
        if call.floor > stream.floor:
            stream.floor = call.floor
            stream.answers = {key: one for key, one in stream.answers.items() if key >= call.floor}
        stream.next = max(stream.next, stream.floor)
        if call.stream != ORDERS and call.number > stream.next:
            raise Refused(path=self.path, reason=OUT_OF_ORDER)  # One before it was lost, and comes again.
        answer: asyncio.Future[Back] = self._node.loop.create_future()
        stream.answers[call.number] = answer
        before, stream.next = stream.next, max(stream.next, call.number + 1)
        try:
            back = await handle(call)
        except BaseException:
            stream.answers.pop(call.number, None)
            stream.next = min(stream.next, before) if call.number == before else stream.next
            answer.cancel()
            raise
        answer.set_result(back)
        return back

    def plain(self) -> None:
        """Something came that was not sealed."""
        self.rejected[PLAIN] += 1
        self._refuse(PLAIN)

    def _refused(self, reason: str, *, counts: bool = False) -> Refused:
        if counts:
            self.rejected[reason] += 1
        self._refuse(reason)
        return Refused(path=self.path, reason=reason)

    def _refuse(self, reason: str) -> None:
        self._node.emit(FrameRefused(self._address, self.path, reason, self.rejected[reason]))

    def _check_open(self) -> None:
        if self._is_closed:
            raise Refused(path=self.path, reason=CLOSED)

    def close(self) -> None:
        """End all sessions; nothing is sent or accepted any more."""
        self._is_closed = True
        for session in self._sessions.values():
            session.close()
        self._sessions.clear()
        self._responses.clear()
        for partner in self._partners.values():
            partner.session = None
            partner.queue.clear()


def digest_of(hello: bytes) -> bytes:
    """What a hand-shake is known by."""
    return hashlib.sha256(hello).digest()


def write_whole(file: Path, content: bytes) -> None:
    """All of it or nothing of it is there; mode 0600."""
    try:
        if file.read_bytes() == content:
            return
    except FileNotFoundError:
        pass
    descriptor, name = tempfile.mkstemp(dir=file.parent, prefix=f".{file.name}.")
    with os.fdopen(descriptor, "wb") as out:
        out.write(content)
    os.replace(name, file)
