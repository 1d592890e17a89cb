"""What the address of a store says: where the servers are, and by which files; and what is refused."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from holdfast.cluster.nats.access import access_of, connect_options
from holdfast.cluster.nats.server_file import new_seed
from holdfast.errors import SpecError


@pytest.fixture
def seed(tmp_path: Path) -> Path:
    file = tmp_path / "node.nk"
    file.touch(0o600)
    file.write_text(new_seed() + "\n")
    return file


def test_an_address_names_servers_and_a_system() -> None:
    access = access_of("nats://127.0.0.1:5222,localhost,[::1]:7/app?insecure=no")
    assert access.name == "nats://127.0.0.1:5222,localhost:4222,[::1]:7/app"
    assert access.servers == ("nats://127.0.0.1:5222", "nats://localhost:4222", "nats://[::1]:7")
    assert (access.system, access.replicas) == ("app", 3)


@pytest.mark.parametrize(
    ("store", "replicas"),
    [("nats://127.0.0.1/app", 1), ("nats://127.0.0.1:1,127.0.0.1:2/app", 1), ("nats://127.0.0.1/app?replicas=3", 3)],
)
def test_replicas_are_three_where_three_servers_are_named(store: str, replicas: int) -> None:
    assert access_of(store).replicas == replicas


def test_the_address_goes_before_the_settings(seed: Path) -> None:
    access = access_of(f"nats://127.0.0.1/app?nkey={seed}", {"replicas": 3, "nkey": "/elsewhere"})
    assert (access.nkey, access.replicas) == (str(seed), 3)


@pytest.mark.parametrize(
    ("store", "problem"),
    [
        ("sqlite:app.db", "must be nats://HOST"),
        ("nats://127.0.0.1", "names no system"),
        ("nats:///app", "a server has no host"),
        ("nats://127.0.0.1:many/app", "has no valid port"),
        ("nats://127.0.0.1:70000/app", "has no valid port"),
        ("nats://127.0.0.1,127.0.0.1:4222/app", "named twice"),
        ("nats://[::1/app", "is no address"),
        ("nats://127.0.0.1/a.b", "must be at most 64 letters"),
        ("nats://127.0.0.1/app/*", "must be at most 64 letters"),
        ("nats://127.0.0.1/app?replicas=2", "the loss of either stops both"),
        ("nats://127.0.0.1/app?nkeys=/x", "there is no setting 'nkeys': there are ca, certificate"),
        ("nats://127.0.0.1/app?insecure=perhaps", "insecure must be true or false"),
        ("nats://127.0.0.1/app?creds=", "creds must be the path of a file"),
        ("nats://127.0.0.1/app?nkey=/nowhere", "the file /nowhere cannot be read: No such file"),
        ("nats://127.0.0.1/app?key=/nowhere", "belong together"),
        ("nats://127.0.0.1/app?nkey=/a&creds=/b", "both creds and nkey"),
        ("nats://127.0.0.1/app?nkey=/a&nkey=/b", "nkey is said twice"),
        ("nats://127.0.0.1/app?nkey=/tmp", "/tmp must be a regular file"),
        ("nats://127.0.0.1/app?creds=/tmp", "/tmp must be a regular file"),
        ('nats://a"b/app?insecure=1', "is no host"),
        ("nats://10.0.0.1/app", "10.0.0.1:4222 is another machine"),
        ("nats://127.0.0.1,db.example/app", "db.example:4222 is another machine"),
    ],
)
def test_a_wrong_address_is_refused_with_what_to_do(store: str, problem: str) -> None:
    with pytest.raises(SpecError, match=r"^store: ") as refused:
        access_of(store)
    assert problem in str(refused.value)


def test_other_machines_are_reached_with_tls_or_where_the_network_is_trusted() -> None:
    assert access_of("tls://db.example/app").is_encrypted
    assert access_of("nats://db.example/app?ca=/ca.pem").is_encrypted
    assert not access_of("nats://db.example/app?insecure=true").is_encrypted
    assert not access_of("nats://db.example/app", {"insecure": True}).is_encrypted


def test_no_password_of_an_address_is_repeated() -> None:
    for store in ("nats://root:hunter2@127.0.0.1/app", "nats:root:hunter2@127.0.0.1/app", "nats://a:hunter2@b"):
        with pytest.raises(SpecError) as refused:
            access_of(store)
        assert "hunter2" not in str(refused.value)


def test_a_key_in_place_of_its_file_is_not_repeated() -> None:
    seed = new_seed()
    with pytest.raises(SpecError, match="nkey must be the path") as refused:
        access_of(f"nats://127.0.0.1/app?nkey={seed}")
    assert seed not in str(refused.value)


def test_a_file_of_secrets_that_others_may_read_is_refused(seed: Path) -> None:
    store = f"nats://127.0.0.1/app?nkey={seed}"
    seed.chmod(0o640)
    with pytest.raises(SpecError, match=f"others may use .* chmod 600 {seed}"):
        access_of(store)
    seed.chmod(0o600)
    access = access_of(store)
    seed.chmod(0o604)  # between the two
    with pytest.raises(SpecError, match="its mode is 0604"):
        connect_options(access)


def test_a_file_of_credentials_has_to_be_one(seed: Path) -> None:
    access = access_of(f"nats://127.0.0.1/app?creds={seed}")
    with pytest.raises(SpecError, match=r"no user in .* a private key alone is given as nkey="):
        connect_options(access)
    jwt = "-----BEGIN NATS USER JWT-----\nabc\n------END NATS USER JWT------\n"
    key = "-----BEGIN USER NKEY SEED-----\n{}\n------END USER NKEY SEED------\n"
    own = seed.read_text().strip()
    for text, problem in (
        (jwt, "no private key"),
        (key.format(own), "no user"),
        (jwt + key.format("S1"), "no private"),
    ):
        seed.write_text(text)
        with pytest.raises(SpecError, match=problem):
            connect_options(access)
    seed.write_text(jwt + key.format(own))
    assert connect_options(access).get("user_credentials") == str(seed)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file away")
def test_a_file_of_secrets_of_somebody_else_is_refused(seed: Path) -> None:
    os.chown(seed, 12345, -1)
    with pytest.raises(SpecError, match="belongs to the user 12345"):
        access_of(f"nats://127.0.0.1/app?nkey={seed}")


def test_a_file_that_is_no_key_is_refused_and_not_repeated(seed: Path) -> None:
    seed.write_text("SUAhunter2")
    with pytest.raises(SpecError, match="no private key") as refused:
        connect_options(access_of(f"nats://127.0.0.1/app?nkey={seed}"))
    assert "hunter2" not in str(refused.value)


def test_a_connection_is_tried_for_ever_and_found_silent_soon(seed: Path) -> None:
    access = access_of(f"nats://127.0.0.1/app?nkey={seed}")
    options = connect_options(access)
    assert (options.get("allow_reconnect"), options.get("max_reconnect_attempts")) == (True, -1)
    assert options.get("ping_interval", 0) * options.get("max_outstanding_pings", 0) == 4
    assert seed.read_text().strip() not in f"{access!r} {options!r}"


def test_files_that_are_no_certificates_are_refused(tmp_path: Path) -> None:
    (tmp_path / "ca.pem").write_text("nothing")
    with pytest.raises(SpecError, match="cannot be read"):
        connect_options(access_of(f"tls://db.example/app?ca={tmp_path / 'ca.pem'}"))
