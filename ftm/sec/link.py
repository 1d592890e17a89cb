"""A secured link of one participant to others: sessions made when they are needed, frames until they are answered.

Whoever sits between may alter, drop, replay and forge: what is refused or lost is sealed anew and sent again, and what
comes twice is handled once, in order. A session is made for each pair of lives and each epoch, and when one is over.
"""

from __future__ import annotations

import asyncio
import contextvars
import hashlib
import time
from collections import deque
from typing import Any

import msgspec

from ...actors.errors import AskTimeout, HoldfastError
from ...actors.kernel.message import Message, message_name
from ..bricks.sealed_frames import (
    ORDERS,
    TELLS,
    Agree,
    Back,
    Call,
    Greet,
    Handle,
    LinkLost,
    OpenNumbers,
    Part,
    Reach,
    Refused,
    Sealed,
    Still,
)
from .authority import AwaitRevocations, GetRevocations
from .certificates import HEARTBEAT
from .handshake import Participant, Response
from .identity import Identity, root_file
from .keys import Secret
from .participants import LinkEnd, certified
from .sec_errors import (
    CLOSED,
    MALFORMED,
    REPLAYED,
    REVOKED,
    STALE_LIST,
    UNTRUSTED,
    WRONG_PEER,
    WRONG_SESSION,
    Rejected,
)
from .session import HEAD, Session

CALL, BACK = b"call", b"back"
PLAIN, OUT_OF_ORDER = "plain", "out_of_order"
FIRST_WAIT, LONGEST_WAIT = 0.5, 8.0
"""Seconds until a frame that is not answered is sent again; doubled each time."""
HEARD_WITHIN = HEARTBEAT + LONGEST_WAIT
"""Seconds in which the authority says something."""
REFUSED_FOR = 5.0
"""Seconds for which one end refuses all that the other one says: then they will not agree any more."""
FIRST_PAUSE, LONGEST_PAUSE = 0.002, 0.25
"""Seconds until a frame that was refused is sent again; the same."""
MOST_BYTES = 1_000_000
"""Of messages in one frame, if there are several."""
MOST_REPLICAS = 64
MOST_RESPONSES = 32
"""Hand-shakes that others have begun, and not ended: the oldest are forgotten."""


class Stream:
    """Numbered calls of one kind that one partner has sent."""

    __slots__ = ("answers", "floor", "next")

    def __init__(self) -> None:
        self.next = self.floor = 0
        self.answers: dict[int, asyncio.Future[Back]] = {}


class Partner(Secret):
    """Another participant, as this one knows it."""

    __slots__ = ("inward", "life", "lock", "name", "outward", "path", "pump", "queue", "refused", "session")

    def __init__(self, path: str) -> None:
        self.path, self.name = path, certified(path)
        self.session: Session | None = None
        self.lock = asyncio.Lock()
        self.outward: dict[str, OpenNumbers] = {}
        self.inward: dict[str, Stream] = {}
        self.life = -1  # whose calls those are
        self.queue: deque[tuple[Part, Reach, Still]] = deque()
        self.pump: asyncio.Task[None] | None = None
        self.refused: tuple[float, float] | None = None  # since when all is, and when that was seen last


class Link(Identity):
    """One end of secured links."""

    def __init__(self, end: LinkEnd) -> None:
        super().__init__(end)
        self._know_names(end.address)
        self._partners: dict[str, Partner] = {}
        self._sessions: dict[bytes, Session] = {}
        self._responses: dict[bytes, Response] = {}
        self._barred: set[str] = set()  # by address: whoever was revoked, until its next life
        self._is_closed = False
        self._watcher: asyncio.Task[None] | None = None

    # -- where it is ------------------------------------------------------------------------------------------------

    def _know_names(self, address: str) -> None:
        """Know by their names in certificates those who take part at an address."""
        self._proxy = certified(f"{address}/ftm/proxy")
        below = (f"{address}/ftm/r{number}" for number in range(1, MOST_REPLICAS + 1))
        self._replicas = {certified(path): path for path in below}

    def readdress(self, address: str) -> None:
        """Go on at another address, under the names that are certified there; sessions are agreed on anew.

        What is on its way is sealed anew and sent again, and what has come before is known: it is handled once.
        """
        was, self._address = self._address, address
        self._know_names(address)
        self.path, self._me = address + self.path[len(was) :], None
        self._barred = {address + path[len(was) :] for path in self._barred}
        self._enrolled = {address + path[len(was) :]: 0 for path in self._enrolled}
        self._end_sessions()
        for partner in self._partners.values():
            partner.path = address + partner.path[len(was) :]
            partner.name = certified(partner.path)
        self._partners = {partner.name: partner for partner in self._partners.values()}

    def _end_sessions(self) -> None:
        for session in self._sessions.values():
            session.close()
        self._sessions.clear()
        self._responses.clear()
        for partner in self._partners.values():
            partner.session = None

    # -- revocation -------------------------------------------------------------------------------------------------

    async def _identity(self) -> Participant:
        me = await super()._identity()
        if self._watcher is None and not self._is_closed:
            self._watcher = self._node.loop.create_task(self._watch(), context=contextvars.Context())
        self._end_distrusted(me)
        return me

    async def _watch(self) -> None:
        """Hear from the authority who was revoked, at once; without word from it for too long believe nobody."""
        while True:
            me = self._me
            try:
                if me is not None:
                    me.take_list(await self._authority(AwaitRevocations(me.trust.list_digest), HEARD_WITHIN))
            except Rejected as error:
                self._refuse(error.reason)
                await asyncio.sleep(LONGEST_WAIT)
            except HoldfastError:  # It is between two lives.
                await asyncio.sleep(FIRST_WAIT)
            if me is None:
                await asyncio.sleep(FIRST_WAIT)
            else:
                self._end_distrusted(me)

    def _end_distrusted(self, me: Participant) -> None:
        is_current = me.trust.is_list_current(time.time())
        for session in self._sessions.values():
            if not is_current or me.trust.is_revoked(session.peer.serial):
                session.close(REVOKED if is_current else STALE_LIST)
        for path, serial in list(self._enrolled.items()):
            if me.trust.is_revoked(serial) and path not in self._barred:
                self._bar(path)

    def _bar(self, path: str) -> None:
        """The certificate of one of ours was revoked: nothing is exchanged with it until its next life has another."""
        if path == self.path:
            self._renew(path)
            self._me = None
            self._end_sessions()
        else:
            self._barred.add(path)
            self._distrust(path, f"its certificate is not accepted ({REVOKED})")

    def _distrust(self, path: str, why: str) -> None:
        if self._end.distrusts is not None:
            self._end.distrusts(path, why)

    def _renew(self, path: str) -> None:
        self._enrolled.pop(path, None)

    def begins_life(self, path: str) -> None:
        """Whoever lives there now is another than before: if that one was revoked, this one gets a key of its own."""
        self._partner(path).refused = None
        if path in self._barred:
            self._barred.discard(path)
            self._renew(path)

    # -- hand-shakes ------------------------------------------------------------------------------------------------

    def _partner(self, path: str) -> Partner:
        name = certified(path)
        found = self._partners.get(name)
        if found is None:
            found = self._partners[name] = Partner(path)
        return found

    async def _session(self, partner: Partner, reach: Reach) -> Session:
        """A session of this epoch and these lives."""
        epoch = self._epoch()
        async with partner.lock:
            session = partner.session
            if session is not None and session.is_open and session.epoch == epoch:
                return session
            if self._enrols is not None and partner.path not in self._enrolled:
                await self._enrol(partner.path)
            me = await self._identity()
            begun = me.begin(partner.name)
            answer = await reach(Greet(begun.hello), FIRST_WAIT)
            session, finish = begun.finish(answer)
            await reach(Agree(digest_of(begun.hello), finish), FIRST_WAIT)
            if me is not self._me:  # Agreed on under another name, or another certificate.
                raise Refused(path=self.path, reason=CLOSED)
            self._keep(partner, session)
            return session

    def _keep(self, partner: Partner, session: Session) -> None:
        partner.session = session
        self._sessions = {key: one for key, one in self._sessions.items() if one.is_open}
        self._sessions[session.number] = session
        if partner.path in self._enrolled:
            self._enrolled[partner.path] = session.peer.serial

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
        file = root_file(self.mechanism.folder, self.mechanism.authority)
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
        if name != self._proxy and name not in self._replicas:  # It was greeted where we were before.
            raise self._refused(WRONG_PEER, counts=True)
        self._keep(self._partner(self._replicas.get(name, f"{self._address}/ftm/proxy")), session)

    # -- out --------------------------------------------------------------------------------------------------------

    def tell(self, path: str, message: Message[Any], reach: Reach, still: Still) -> None:
        """Bring a message there, once, behind those that were told before; `still` says whether it is wanted."""
        if self._is_closed:
            return
        partner = self._partner(path)
        partner.queue.append((self._part(message), reach, still))
        if partner.pump is None:
            partner.pump = self._node.loop.create_task(self._send_all(partner), context=contextvars.Context())

    def _part(self, message: Message[Any]) -> Part:
        return Part(message_name(type(message)), self._node.codec.encode(message, self._address))

    async def _send_all(self, partner: Partner) -> None:
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
                    await self._call(partner, TELLS, parts, reach, still)
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
        return await self._call(self._partner(path), stream, [part], reach, still, epoch, config)

    async def _call(
        self,
        partner: Partner,
        name: str,
        parts: list[Part],
        reach: Reach,
        still: Still,
        epoch: int = -1,
        config: int = -1,
    ) -> Back:
        numbers = partner.outward.setdefault(name, OpenNumbers())
        number = numbers.open()
        wait, pause = FIRST_WAIT, FIRST_PAUSE
        try:
            while still() and not self._is_closed:
                session: Session | None = None
                try:
                    session = await self._session(partner, reach)
                    text = msgspec.msgpack.encode(Call(name, number, numbers.floor, parts, epoch, config))
                    reply = await reach(Sealed(session.seal(text, CALL)), wait)
                    opened = session.open(reply, BACK + number.to_bytes(8, "big"))
                    partner.refused = None
                    return msgspec.msgpack.decode(opened, type=Back)
                except AskTimeout:
                    wait = min(2 * wait, LONGEST_WAIT)
                    continue
                except Rejected as error:
                    self._refuse(error.reason)
                    await self._judge(partner, error.reason)
                except Refused as no:
                    if no.reason != OUT_OF_ORDER and session is not None and partner.session is session:
                        partner.session = None  # The other end may have none.
                    await self._judge(partner, no.reason)
                except HoldfastError:
                    pass  # It is between two lives, or at its end, which whoever asks is told.
                await asyncio.sleep(pause)
                pause = min(2 * pause, LONGEST_PAUSE)
            raise LinkLost(partner.path)
        finally:
            numbers.close(number)

    async def _judge(self, partner: Partner, reason: str) -> None:
        """Distrust one that nothing has been exchanged with for too long, but for refusals.

        While the authority is not heard, or its list here is too old, nobody is believed, and nobody is to blame.
        """
        now = self._node.loop.time()
        since, last = partner.refused or (now, now)
        if reason == OUT_OF_ORDER or now - last > REFUSED_FOR / 2:  # It was answered; or nothing was said meanwhile.
            since = now
        partner.refused = since, now
        if now - since > REFUSED_FOR:
            partner.refused = None
            try:
                await self._authority(GetRevocations())
            except HoldfastError:
                return
            me = self._me
            if me is None or not me.trust.is_list_current(time.time()):
                return
            self._distrust(partner.path, f"nothing passes on its link ({reason})")

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

    def _check_open(self) -> None:
        if self._is_closed:
            raise Refused(path=self.path, reason=CLOSED)

    def close(self) -> None:
        """End all sessions; nothing is sent or accepted any more."""
        self._is_closed = True
        if self._watcher is not None:
            self._watcher.cancel()
        self._end_sessions()
        for partner in self._partners.values():
            partner.queue.clear()


def digest_of(hello: bytes) -> bytes:
    """What a hand-shake is known by."""
    return hashlib.sha256(hello).digest()
