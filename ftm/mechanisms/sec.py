"""Secured links (SEC): what goes between proxy and replicas, and between replicas, is ciphered, signed and fresh.

Fault model  somebody sits on the links: reads, alters, forges, replays, drops, delays, speaks as another.
Guarantee    nothing can be read there; what was altered, forged, replayed, is another's or too old is refused, counted
             by reason and told (`FrameRefused`); what was refused or lost is sent again, and handled once, in order.
Not covered  who sees or runs the processes; sizes and times; one who drops everything; heartbeats, which say no more
             than that somebody is alive: to forge them does no more harm than to drop what the replica sends.
Needs        a certification authority (`CertificationAuthority`), and `pip install holdfast[sec]`.
Cost         a signature each at both ends for a session; then a seal for each batch and each acknowledgement.
Source       Lauer et al. 2018, figure 6 (A66 to A75); traps T47, T48.

It ends in front of the journal: what is journaled is plain. It stands outermost, around the reply log, which has to be
read by a replica that leads later. Keys are files of mode 0600 in a directory that only this user can enter.
"""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import copy
import dataclasses
import functools
import hashlib
import importlib
import os
import re
import stat
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

from ...actors.errors import HoldfastError
from ...actors.kernel.actor import Actor, on
from ...actors.kernel.envelope import ReplyHandle
from ..bricks.brick_messages import Done, Outward, Taken
from ..bricks.bricks import FOREVER, After, Before
from ..bricks.sealed_frames import (
    ORDERS,
    Agree,
    Back,
    Call,
    Greet,
    LinkLost,
    Opened,
    Refused,
    Sealed,
    encode_reply,
    tell_over,
)
from ..model.mechanism import Mechanism, MechanismRefused, Role

if TYPE_CHECKING:
    from ...actors.kernel.message import Message
    from ...actors.kernel.node import Node
    from ..bricks.sealed_frames import SecuredLink


ANSWERED_WITHIN = 1.0
"""Seconds that the end of a link waits for what has come over it."""


class Opening(Before):
    """Before of a secured replica: opens and verifies what comes, and hands it to the protocol (A72)."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._replies: set[asyncio.Task[None]] = set()

    @on(Greet)
    def greet(self, message: Greet) -> ReplyHandle[bytes]:
        """Answer the greeting with which somebody begins a hand-shake."""
        return self._later(self._link.greet(message.hello))

    @on(Agree)
    def agree(self, message: Agree) -> ReplyHandle[None]:
        """Complete a hand-shake, from which on there is a session."""
        return self._later(self._link.agree(message.hello, message.finish))

    @on(Sealed)
    def sealed(self, message: Sealed) -> ReplyHandle[bytes]:
        """Open a sealed frame, and pass on what is in it."""
        return self._later(self._link.take(message.frame, self._do))

    @property
    def _link(self) -> SecuredLink:
        link = self._standing.link
        if link is None:
            raise Refused(path=self._standing.path, reason="closed")
        return link

    def _later(self, work: Any) -> ReplyHandle[Any]:
        handle: ReplyHandle[Any] = self.ctx.reply_handle()
        task = self.ctx.create_task(self._reply(handle, work))
        self._replies.add(task)
        task.add_done_callback(self._replies.discard)
        return handle

    async def answered(self) -> None:
        """Wait, but not for long, until all that has come is answered."""
        if self._replies:
            await asyncio.wait(list(self._replies), timeout=ANSWERED_WITHIN)

    async def _reply(self, handle: ReplyHandle[Any], work: Any) -> None:
        try:
            handle.reply(await work)
        except HoldfastError as no:
            handle.fail(no)

    async def _do(self, call: Call) -> Back:
        standing = self._standing
        codec = standing.node.codec
        from ..bricks.request_protocol import OPENED

        for part in call.parts:
            message = codec.decode(OPENED[part.name], part.body)
            opened = Opened(standing.opened.put(message))
            if call.stream != ORDERS:
                self.next.tell(opened)
                continue
            try:
                return encode_reply(codec, await self.next.ask(opened, timeout=FOREVER))
            except HoldfastError as error:
                return Back(*codec.encode_error(error))
        return Back("", "", b"")


class Sealing(After):
    """After of a secured replica: seals what leaves for the proxy (A73)."""

    @on(Done)
    async def _done(self, done: Done) -> Taken:
        self._send(done)
        return Taken()

    @on(Outward)
    def _outward(self, outward: Outward) -> None:
        self._send(outward)

    def _send(self, message: Message[Any]) -> None:
        standing = self._standing
        link, epoch = standing.link, standing.epoch
        if link is not None:
            tell_over(
                link, self.next._cell, message, lambda: standing.epoch == epoch and not standing.is_fenced
            )  # fmt: skip


SUITES = ("aes-256-gcm", "chacha20-poly1305")
"""Ciphers that there are."""


_MADE = re.compile(r"\.?[0-9a-f]{32}\.(key|root)(\..+)?")
"""Names of the files that a participant makes among the keys."""
_FOLDER = re.compile(r"holdfast-sec-(\w+)-(\d+)-(\d+)-\w+")
"""A directory of keys: where its pid means something, the pid of its process, and when that began."""


@functools.cache
def _folder_of(process: int) -> str:
    """The directory for keys that end with this process; those of killed processes go."""
    import tempfile  # only now: it brings every kind of compression

    from ...checkpoint.sqlite.ownership import boot_id, living, start_of

    boot, start = boot_id(), (start_of(process) or "").rpartition(":")[2]
    where = hashlib.sha256(f"{boot} {os.readlink('/proc/self/ns/pid')}".encode()).hexdigest()[:12]
    for beside in Path(tempfile.gettempdir()).glob("holdfast-sec-*"):
        found = _FOLDER.fullmatch(beside.name)
        if found is not None and found[1] == where:
            with living(int(found[2]), f"{boot}:{found[3]}") as pidfd:
                if pidfd is None:
                    _remove(beside)
    folder = tempfile.mkdtemp(prefix=f"holdfast-sec-{where}-{process}-{start}-")
    made = os.lstat(folder)

    def remove() -> None:
        if os.getpid() == process:  # A forked process ends, too.
            _remove(folder, made)

    atexit.register(remove)
    return folder


def _remove(folder: str | Path, made: os.stat_result | None = None) -> None:
    """Remove a directory of keys of this user, if it is still that which was made, and has only keys in it."""
    with contextlib.suppress(OSError):  # Somebody was there before us, or has put something there: it stays.
        found = os.lstat(folder)
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid() and os.path.samestat(found, made or found):
            for name in filter(_MADE.fullmatch, os.listdir(folder)):
                os.unlink(os.path.join(folder, name))
            os.rmdir(folder)


@dataclasses.dataclass(frozen=True)
class SEC(Mechanism):
    """Secured links: replicas prove who they are by certificates, and all that goes between them is sealed.

    Args:
        authority: the address of the `CertificationAuthority`.
        keys: the directory of the participants' keys, which only this user may enter; "": new keys at each start.
        fingerprint: the beginning of the SHA-256 of the authority's public key, in hex; "": it is believed.
        rotate_messages, rotate_seconds: after so many frames, or so long, the keys of a session are exchanged.
        lifetime: seconds after which a session is over, and another one is agreed on.
        renew_days: a certificate is renewed when so many days are left.
        suites: ciphers, the best first.
    """

    name: ClassVar[str] = "sec"
    replicas: ClassVar[int] = 1
    tolerates: ClassVar[frozenset[str]] = frozenset({"eavesdropping", "forgery", "replay"})
    needs: ClassVar[frozenset[str]] = frozenset({"certificates"})
    bandwidth: ClassVar[str] = "low"
    cpu: ClassVar[str] = "low"
    units: ClassVar[int] = 1
    layer: ClassVar[str] = "link"
    roles: ClassVar[dict[str, Role]] = {"end": Role(before=Opening, after=Sealing)}

    authority: str
    keys: str = ""
    fingerprint: str = ""
    rotate_messages: int = 1 << 20
    rotate_seconds: float = 3600.0
    lifetime: float = 86_400.0
    renew_days: float = 7.0
    suites: tuple[str, ...] = SUITES
    is_per_start: bool = False

    def __post_init__(self) -> None:
        if not str(self.authority).startswith("/"):
            raise ValueError(f"SEC: authority must be an address such as '/app/authority', not {self.authority!r}")
        for name in ("rotate_messages", "rotate_seconds", "lifetime"):
            if getattr(self, name) <= 0:
                raise ValueError(f"SEC: {name} must be > 0, not {getattr(self, name)!r}")
        if unknown := [suite for suite in self.suites if suite not in SUITES]:
            raise ValueError(f"SEC: unknown suites {', '.join(unknown)}; there are {', '.join(SUITES)}")
        if not self.keys:
            object.__setattr__(self, "is_per_start", True)
        object.__setattr__(self, "suites", tuple(self.suites))

    def check(self, kind: type[Actor], where: str = "") -> None:
        """Refuse to go on without the extra, or with a directory that is not safe."""
        super().check(kind, where)
        try:
            importlib.import_module("..sec.link", __package__)
        except ImportError as error:
            raise MechanismRefused(self.name, str(error)) from error
        if not self.keys:
            return
        try:
            about = os.lstat(self.keys)
        except OSError as error:
            raise MechanismRefused(self.name, f"the directory of keys {self.keys} cannot be used: {error}") from error
        if not stat.S_ISDIR(about.st_mode):
            raise MechanismRefused(self.name, f"{self.keys} is no directory, and links are not followed")
        if about.st_uid != os.geteuid() or about.st_mode & 0o077:
            raise MechanismRefused(self.name, f"{self.keys} must belong to this user, with mode 0700")

    @property
    def folder(self) -> str:
        """The directory of the keys; made where links are first opened, which is not where all such classes are."""
        return self.keys or _folder_of(os.getpid())

    def for_replicas(self) -> Self:
        new = copy.copy(self)
        object.__setattr__(new, "keys", self.folder)
        return new

    def open_link(
        self,
        node: Node,
        address: str,
        path: str,
        epoch: Callable[[], int],
        enrols: Callable[[], list[str]] | None = None,
        distrusts: Callable[[str, str], None] | None = None,
    ) -> SecuredLink:
        """Open this participant's end of its links."""
        from ..sec.link import Link
        from ..sec.participants import LinkEnd

        return Link(LinkEnd(node, address, path, self, epoch, enrols, distrusts))


__all__ = ["SEC", "LinkLost", "Opening", "Sealing"]
