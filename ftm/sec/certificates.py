"""X.509 certificates of participants, issued by one authority, and its list of those that were revoked.

A name in a certificate is a participant's: an address, or a word for a client. All bytes are DER.
"""

from __future__ import annotations

import datetime as dt
import hashlib
from collections.abc import Iterable
from typing import Final

import msgspec
from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from cryptography.x509.oid import NameOID

from .keys import SigningKey, is_signed
from .sec_errors import EXPIRED, MALFORMED, NOT_YET, REVOKED, STALE_LIST, UNTRUSTED, WRONG_PEER, Rejected

DER: Final = serialization.Encoding.DER
LIFETIME: Final = dt.timedelta(days=30)
ROOT_LIFETIME: Final = dt.timedelta(days=3650)
LIST_LIFETIME: Final = dt.timedelta(minutes=10)
HEARTBEAT: Final = 60.0
"""Seconds after which an authority that lives says again what it has revoked."""
SKEW: Final = dt.timedelta(minutes=5)
"""How far the clocks of two participants may be apart."""
MOST_BYTES: Final = 16_384
MOST_NAME: Final = 64
_SIGNED_BY_ED25519: Final = bytes.fromhex("300506032b6570034100")
"""DER between what is signed and an Ed25519 signature: the algorithm, and that 64 whole bytes follow."""
_UNREADABLE: Final = (
    ValueError,
    TypeError,
    UnsupportedAlgorithm,
    x509.InvalidVersion,
    x509.ExtensionNotFound,
    x509.DuplicateExtension,
    Warning,
)
"""What reading rubbish raises: parts are read only when they are looked at. Warnings, where these are errors."""


class CertifiedPeer(msgspec.Struct, frozen=True):
    """Whom a certificate is about, after it was verified. `until` is Unix time in seconds."""

    name: str
    public: bytes
    serial: int
    until: float

    def key(self) -> Ed25519PublicKey:
        """What its signatures are verified with."""
        return Ed25519PublicKey.from_public_bytes(self.public)


def utc(seconds: float) -> dt.datetime:
    """Unix time, as certificates have it."""
    return dt.datetime.fromtimestamp(seconds, dt.UTC)


def make_root(key: SigningKey, name: str, now: float, lifetime: dt.timedelta = ROOT_LIFETIME) -> bytes:
    """The authority's own certificate, signed by itself."""
    subject = _name(name)
    builder = _builder(subject, subject, key.public, x509.random_serial_number(), now, lifetime)
    builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
    builder = builder.add_extension(_usage(signs_certificates=True), critical=True)
    return builder.sign(key.private, None).public_bytes(DER)


def make_request(key: SigningKey, name: str) -> bytes:
    """What a participant asks a certificate with; its signature shows that it has the key."""
    return x509.CertificateSigningRequestBuilder().subject_name(_name(name)).sign(key.private, None).public_bytes(DER)


def read_request(data: bytes) -> tuple[str, bytes]:
    """The name and the public key in a request.

    Raises:
        Rejected: it is malformed, of another kind of key, or not signed with its own key.
    """
    if len(data) > MOST_BYTES:
        raise Rejected(MALFORMED, "a request for a certificate")
    try:
        request = x509.load_der_x509_csr(data)
        key = request.public_key()
        is_valid = isinstance(key, Ed25519PublicKey) and _is_of(
            key, data, request.tbs_certrequest_bytes, request.signature
        )
        name = _common_name(request.subject)
    except _UNREADABLE:
        raise Rejected(MALFORMED, "a request for a certificate") from None
    if not isinstance(key, Ed25519PublicKey) or not is_valid:
        raise Rejected(UNTRUSTED, "a request for a certificate")
    return name, key.public_bytes(serialization.Encoding.Raw, serialization.PublicFormat.Raw)


def issue(
    root_key: SigningKey,
    root: bytes,
    name: str,
    public: bytes,
    now: float,
    lifetime: dt.timedelta = LIFETIME,
    serial: int | None = None,
) -> bytes:
    """A certificate for a participant. It can sign, and issue nothing."""
    authority = x509.load_der_x509_certificate(root)
    key = Ed25519PublicKey.from_public_bytes(public)
    number = x509.random_serial_number() if serial is None else serial
    builder = _builder(_name(name), authority.subject, key, number, now, lifetime)
    builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
    builder = builder.add_extension(_usage(signs_certificates=False), critical=True)
    return builder.sign(root_key.private, None).public_bytes(DER)


def make_list(
    root_key: SigningKey,
    root: bytes,
    serials: dict[int, float],
    number: int,
    now: float,
    lifetime: dt.timedelta = LIST_LIFETIME,
) -> bytes:
    """The signed list of revoked serial numbers, with when each was; `number` rises with each list."""
    authority = x509.load_der_x509_certificate(root)
    builder = (
        x509.CertificateRevocationListBuilder()
        .issuer_name(authority.subject)
        .last_update(utc(now) - SKEW)
        .next_update(utc(now) + lifetime)
        .add_extension(x509.CRLNumber(number), critical=False)
    )
    for serial, when in serials.items():
        revoked = x509.RevokedCertificateBuilder().serial_number(serial).revocation_date(utc(when)).build()
        builder = builder.add_revoked_certificate(revoked)
    return builder.sign(root_key.private, None).public_bytes(DER)


def public_of(certificate: bytes) -> bytes:
    """The public key in a certificate of our own making."""
    key = x509.load_der_x509_certificate(certificate).public_key()
    return key.public_bytes(serialization.Encoding.Raw, serialization.PublicFormat.Raw)


def about(certificate: bytes) -> tuple[int, float]:
    """The serial number of a certificate of our own making, and until when it is valid, as Unix time."""
    read = x509.load_der_x509_certificate(certificate)
    return read.serial_number, read.not_valid_after_utc.timestamp()


def digest_of(serials: Iterable[int]) -> bytes:
    """What revoked serial numbers are compared by."""
    return hashlib.sha256(" ".join(map(str, sorted(serials))).encode()).digest()


class Trust:
    """Whom a participant believes: one authority, and its newest list of revocations.

    Args:
        root: the authority's certificate; how it got here is what all trust rests on.
        needs_list: refuse everybody while there is no list, or only one whose time is over.
    """

    def __init__(self, root: bytes, *, needs_list: bool = False) -> None:
        self._root = x509.load_der_x509_certificate(root)
        key = self._root.public_key()
        constraints = self._root.extensions.get_extension_for_class(x509.BasicConstraints).value
        if not isinstance(key, Ed25519PublicKey) or not constraints.ca:
            raise Rejected(UNTRUSTED, "the certificate of the authority")
        if not is_signed(key, self._root.signature, self._root.tbs_certificate_bytes):
            raise Rejected(UNTRUSTED, "the certificate of the authority")
        self.root = root
        self.needs_list = needs_list
        self.list_number = -1
        self._key = key
        self._revoked: frozenset[int] = frozenset()
        self._list_until = 0.0

    def take_list(self, data: bytes, now: float) -> bool:
        """Believe a list of revocations from here on; False if it is older than the one there is.

        Raises:
            Rejected: it is malformed, not from our authority, or its time is over.
        """
        what = "a list of revocations"
        try:
            listed = x509.load_der_x509_crl(data)
            if not _is_of(self._key, data, listed.tbs_certlist_bytes, listed.signature):
                raise Rejected(UNTRUSTED, what)
            is_ours = listed.issuer == self._root.subject
            number = listed.extensions.get_extension_for_class(x509.CRLNumber).value.crl_number
            until = listed.next_update_utc
        except _UNREADABLE:
            raise Rejected(MALFORMED, what) from None
        if not is_ours or until is None:
            raise Rejected(UNTRUSTED, what)
        if utc(now) > until + SKEW:
            raise Rejected(STALE_LIST, what)
        if number < self.list_number:  # Who replays an old list would make revoked ones valid again.
            return False
        self.list_number, self._list_until = number, until.timestamp()
        self._revoked = frozenset(revoked.serial_number for revoked in listed)
        return True

    @property
    def list_digest(self) -> bytes:
        """What is on the list, in short."""
        return digest_of(self._revoked)

    def is_list_current(self, now: float) -> bool:
        """Whether there is a list whose time is not over."""
        return now <= self._list_until

    def is_revoked(self, serial: int) -> bool:
        """Whether a certificate was revoked, as far as is known."""
        return serial in self._revoked

    def verify(self, data: bytes, now: float, name: str | None = None) -> CertifiedPeer:
        """Whom a certificate is about.

        Args:
            data: the certificate.
            now: Unix time.
            name: whose it must be; None for anybody's.

        Raises:
            Rejected: malformed, untrusted, not_yet_valid, expired, revoked, wrong_peer, stale_list.
        """
        if len(data) > MOST_BYTES:
            raise Rejected(MALFORMED, "a certificate")
        try:
            certificate = x509.load_der_x509_certificate(data)
            # First this: what the authority has not signed is not looked into.
            if not _is_of(self._key, data, certificate.tbs_certificate_bytes, certificate.signature):
                raise Rejected(UNTRUSTED, "a certificate")
            key = certificate.public_key()
            subject = _common_name(certificate.subject)
            is_ours = certificate.issuer == self._root.subject
            extensions = certificate.extensions
            is_authority = extensions.get_extension_for_class(x509.BasicConstraints).value.ca
            may_sign = extensions.get_extension_for_class(x509.KeyUsage).value.digital_signature
        except _UNREADABLE:
            raise Rejected(MALFORMED, "a certificate") from None
        what = f"the certificate of {subject!r}"
        # The authority's own certificate is nobody's to speak with.
        if not is_ours or is_authority or not may_sign or not isinstance(key, Ed25519PublicKey):
            raise Rejected(UNTRUSTED, what)
        self._check_time(certificate, now, what)
        self._check_revoked(certificate.serial_number, now, what)
        if name is not None and subject != name:
            raise Rejected(WRONG_PEER, what)
        public = key.public_bytes(serialization.Encoding.Raw, serialization.PublicFormat.Raw)
        return CertifiedPeer(subject, public, certificate.serial_number, certificate.not_valid_after_utc.timestamp())

    def _check_time(self, certificate: x509.Certificate, now: float, what: str) -> None:
        for one in (certificate, self._root):
            if utc(now) < one.not_valid_before_utc:
                raise Rejected(NOT_YET, what)
            if utc(now) > one.not_valid_after_utc:
                raise Rejected(EXPIRED, what)

    def _check_revoked(self, serial: int, now: float, what: str) -> None:
        if self.needs_list and now > self._list_until:
            raise Rejected(STALE_LIST, what)
        if serial in self._revoked:
            raise Rejected(REVOKED, what)


def _is_of(key: Ed25519PublicKey, data: bytes, content: bytes, signature: bytes) -> bool:
    """Whether the content was signed with the key, and the bytes around it are as they must be: nothing is free."""
    return data.endswith(content + _SIGNED_BY_ED25519 + signature) and is_signed(key, signature, content)


def _name(name: str) -> x509.Name:
    if not 0 < len(name) <= MOST_NAME:
        raise ValueError(f"a name in a certificate has 1 to {MOST_NAME} characters, not {len(name)}")
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _common_name(name: x509.Name) -> str:
    parts = name.get_attributes_for_oid(NameOID.COMMON_NAME)
    if len(parts) != 1 or not isinstance(parts[0].value, str):
        raise ValueError("not exactly one common name")
    return parts[0].value


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: Ed25519PublicKey,
    serial: int,
    now: float,
    lifetime: dt.timedelta,
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(serial)
        .not_valid_before(utc(now) - SKEW)
        .not_valid_after(utc(now) + lifetime)
    )


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )
