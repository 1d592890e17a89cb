"""Secured links: certificates from an authority of our own, session keys by agreement, frames that nobody can forge.

Bytes in, bytes out: nothing here sends. Needs `pip install holdfast[sec]`.

Source: Lauer et al. 2018, figure 6 (SEC); the key agreement is that of SIGMA (Krawczyk 2003), with AEAD session keys in
the place of RSA on the payload (trap T47).
"""

from importlib.util import find_spec

if find_spec("cryptography") is None:
    raise ImportError("holdfast.ftm.sec needs the package cryptography: pip install 'holdfast[sec]'")
