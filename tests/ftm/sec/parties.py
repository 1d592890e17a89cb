"""Participants of the tests, with an authority and a clock of their own."""

from typing import Any

from holdfast.ftm.sec.certificates import Trust, issue, make_list, make_request, make_root, read_request
from holdfast.ftm.sec.handshake import Participant
from holdfast.ftm.sec.keys import SigningKey
from holdfast.ftm.sec.sec_errors import Rejected
from holdfast.ftm.sec.session import Session

NOW = 1_800_000_000.0


class Clock:
    """Time that a test moves."""

    def __init__(self) -> None:
        self.now = NOW

    def __call__(self) -> float:
        return self.now


class Office:
    """An authority without an actor around it."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.key = SigningKey.per_start()
        self.root = make_root(self.key, "office", NOW)
        self.revoked: dict[int, float] = {}
        self.lists = 0

    def certificate(self, key: SigningKey, name: str, **options: Any) -> bytes:
        asked, public = read_request(make_request(key, name))
        return issue(self.key, self.root, asked, public, self.clock(), **options)

    def party(self, name: str, incarnation: int = 1, **options: Any) -> Participant:
        key = SigningKey.per_start()
        certificate = self.certificate(key, name)
        options = {"wall": self.clock, "clock": self.clock, **options}
        return Participant(key, certificate, Trust(self.root), incarnation=incarnation, **options)

    def revocations(self, *serials: int) -> bytes:
        self.lists += 1
        self.revoked.update(dict.fromkeys(serials, self.clock()))
        return make_list(self.key, self.root, self.revoked, self.lists, self.clock())


def meet(one: Participant, other: Participant) -> tuple[Session, Session]:
    """The sessions of both, after a hand-shake."""
    begun = one.begin(other.name)
    response = other.answer(begun.hello)
    mine, finish = begun.finish(response.answer)
    return mine, response.complete(finish)


def reason_of(error: BaseException) -> str:
    """Why something was rejected."""
    assert isinstance(error, Rejected)
    return error.reason
