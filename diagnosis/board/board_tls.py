"""How what is sent to a board is encrypted, and where a token may not go in clear."""

from __future__ import annotations

import ssl
from pathlib import Path

from ...actors.errors import SpecError
from ...actors.streams import is_loopback


def check_token(host: str, token: str | None, *, is_encrypted: bool, insecure: bool) -> None:
    """Refuse to say a token to another machine in clear.

    Raises:
        ValueError: it would.
    """
    if token is not None and not (is_encrypted or insecure or is_loopback(host)):
        raise ValueError(
            f"the token would go over the network to {host} in clear: use tls://, or insecure=True where the network "
            "itself is trusted"
        )


def client_tls(ca: str | Path | None, certificate: str | Path | None, key: str | Path | None) -> ssl.SSLContext:
    """How a client encrypts, and whom it believes to be the board.

    Raises:
        SpecError: the files cannot be read, or a certificate is without its key.
    """
    return _with_files(ssl.Purpose.SERVER_AUTH, ca, certificate, key)


def server_tls(certificate: str | Path, key: str | Path, ca: str | Path | None = None) -> ssl.SSLContext:
    """How a board encrypts; with `ca`, each client has to show a certificate that is signed by it.

    Raises:
        SpecError: the files cannot be read.
    """
    context = _with_files(ssl.Purpose.CLIENT_AUTH, ca, certificate, key)
    if ca is not None:
        context.verify_mode = ssl.CERT_REQUIRED
    return context


def _with_files(
    purpose: ssl.Purpose, ca: str | Path | None, certificate: str | Path | None, key: str | Path | None
) -> ssl.SSLContext:
    if (certificate is None) != (key is None):
        raise SpecError("board", "a certificate and its key belong together: give both or none")
    try:
        context = ssl.create_default_context(purpose, cafile=ca)
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        if certificate is not None:
            # An empty password, or OpenSSL would ask for one at the terminal.
            context.load_cert_chain(certificate, key, password="")
    except OSError as error:  # So is an SSLError.
        files = ", ".join(str(one) for one in (ca, certificate, key) if one is not None)
        raise SpecError("board", f"the certificates ({files}) cannot be read: {error}") from error
    return context
