"""Keys are in nobody's hands: not in files that others can read, not in text, not in pickles (T47, T48)."""

import copy
import os
import pickle
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import msgspec
import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ec import SECP256R1, generate_private_key

from holdfast.actors.errors import UnsavableValue
from holdfast.actors.values import encode_value
from holdfast.ftm.sec.keys import SigningKey, is_signed, raw_public
from holdfast.ftm.sec.sec_errors import UnsafeKeyFile
from tests.ftm.sec.parties import Office, meet


def raw(key: SigningKey) -> bytes:
    form = serialization.Encoding.Raw, serialization.PrivateFormat.Raw, serialization.NoEncryption()
    return key.private.private_bytes(*form)


def test_a_key_file_is_made_once_and_is_nobody_elses(tmp_path: Path) -> None:
    path = tmp_path / "key.pem"
    old = os.umask(0)
    try:
        first = SigningKey.from_file(path)
    finally:
        os.umask(old)
    assert path.stat().st_mode & 0o777 == 0o600
    assert SigningKey.from_file(path).fingerprint == first.fingerprint
    assert SigningKey.per_start().fingerprint != first.fingerprint
    assert [file.name for file in tmp_path.iterdir()] == ["key.pem"]


def test_many_who_begin_at_once_get_one_key(tmp_path: Path) -> None:
    found: list[str] = []
    threads = [
        threading.Thread(target=lambda: found.append(SigningKey.from_file(tmp_path / "key").fingerprint))
        for _ in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 8
    assert len(set(found)) == 1


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660, 0o606, 0o644])
def test_a_key_that_others_could_get_at_is_refused(tmp_path: Path, mode: int) -> None:
    path = tmp_path / "key"
    SigningKey.from_file(path)
    path.chmod(mode)
    with pytest.raises(UnsafeKeyFile, match=f"mode is {mode:04o}"):
        SigningKey.from_file(path)


def test_a_key_with_a_second_name_is_refused_unless_its_maker_was_killed(tmp_path: Path) -> None:
    path = tmp_path / "key"
    made = SigningKey.from_file(path).fingerprint
    os.link(path, tmp_path / ".key.half-made")
    assert SigningKey.from_file(path).fingerprint == made
    assert [file.name for file in tmp_path.iterdir()] == ["key"]
    os.link(path, tmp_path / "other")
    with pytest.raises(UnsafeKeyFile, match="several names"):
        SigningKey.from_file(path)
    assert (tmp_path / "other").exists()


def test_what_is_no_key_file_is_refused_and_not_shown(tmp_path: Path) -> None:
    path = tmp_path / "key"
    SigningKey.from_file(path)
    link = tmp_path / "link"
    link.symlink_to(path)
    with pytest.raises(UnsafeKeyFile, match="symbolic links"):
        SigningKey.from_file(link)
    with pytest.raises(UnsafeKeyFile, match="regular file"):
        SigningKey.from_file(tmp_path)
    path.write_text("secret: 4711")
    with pytest.raises(UnsafeKeyFile) as caught:
        SigningKey.from_file(path)
    assert "4711" not in str(caught.value)
    assert caught.value.__cause__ is None
    other = generate_private_key(SECP256R1())
    form = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    path.write_bytes(other.private_bytes(*form))
    with pytest.raises(UnsafeKeyFile, match="not an Ed25519 key"):
        SigningKey.from_file(path)


def test_signatures_are_verified() -> None:
    key, other = SigningKey.per_start(), SigningKey.per_start()
    signature = key.sign(b"text")
    assert is_signed(key.public, signature, b"text")
    assert not is_signed(key.public, signature, b"texT")
    assert not is_signed(other.public, signature, b"text")
    assert not is_signed(key.public, signature[:-1], b"text")


def holders() -> list[Any]:
    office = Office()
    one, other = office.party("a"), office.party("b")
    begun = one.begin("b")
    response = other.answer(begun.hello)
    return [SigningKey.per_start(), one, begun, response, *meet(one, other)]


@pytest.mark.parametrize("index", range(6))
def test_what_holds_keys_is_not_pickled_copied_encoded_or_shown(index: int) -> None:
    holder = holders()[index]
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        with pytest.raises(TypeError, match="neither pickled nor copied"):
            pickle.dumps(holder, protocol)
    for make in (copy.copy, copy.deepcopy):
        with pytest.raises(TypeError, match="neither pickled nor copied"):
            make(holder)
    with pytest.raises((TypeError, msgspec.MsgspecError)):
        msgspec.msgpack.encode(holder)
    with pytest.raises(UnsavableValue):
        encode_value(holder)
    assert not hasattr(holder, "__dict__")  # nothing for tools that print attributes


def test_text_shows_a_fingerprint_of_the_public_half_only() -> None:
    key = SigningKey.per_start()
    text = f"{key!r} {key} {[key]}"
    assert key.fingerprint in text
    assert raw(key).hex() not in text
    assert raw(key) not in raw_public(key.public)
    one, *_ = holders()[1:]
    assert repr(one) == "<Participant 'a' life 1 epoch 0>"
    assert "open" in repr(holders()[4])


def test_importing_holdfast_needs_no_cryptography() -> None:
    program = "import sys, holdfast, holdfast.ftm; sys.exit('cryptography' in sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)


def test_without_the_extra_it_says_what_to_install() -> None:
    program = (
        "import importlib.util as finder\n"
        "real = finder.find_spec\n"
        "finder.find_spec = lambda name, *rest: None if name == 'cryptography' else real(name, *rest)\n"
        "import holdfast.ftm.sec.keys\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert "pip install 'holdfast[sec]'" in done.stderr.splitlines()[-1]
