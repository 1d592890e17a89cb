"""`holdfast.toml` and the environment: which goes before which, and what is refused with file, line and key."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from holdfast.cluster.configuration import Configuration, NatsSettings, read_configuration
from holdfast.cluster.nats.access import SETTINGS, access_of
from holdfast.errors import SpecError

WHOLE = """
# where the shop keeps what it must not lose
store = "nats://127.0.0.1/app"
standby = "warm"
durability = "fsync"

[nats]
ca = "ca.pem"
replicas = 3
insecure = false
"""


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    found = tmp_path / "holdfast.toml"
    found.touch(0o644)
    return found


def test_a_file_says_where_things_are_kept(file: Path) -> None:
    file.write_text(WHOLE)
    nats = NatsSettings(ca=str(file.parent / "ca.pem"), replicas=3, insecure=False)
    expected = Configuration(store="nats://127.0.0.1/app", standby="warm", durability="fsync", nats=nats)
    assert read_configuration(file, {}) == expected
    assert read_configuration(None, {"HOLDFAST_CONFIG": str(file)}) == expected
    assert read_configuration(None, {}) == expected


def test_without_a_file_nothing_is_said(file: Path) -> None:
    file.unlink()
    assert read_configuration(None, {}) == Configuration()


def test_the_environment_goes_before_the_file_and_arguments_before_both(file: Path) -> None:
    file.write_text(WHOLE)
    environ = {"HOLDFAST_STORE": "sqlite:a.db", "HOLDFAST_NATS_REPLICAS": "1", "HOLDFAST_NATS_INSECURE": "true"}
    found = read_configuration(None, {**environ, "HOLDFAST_STANDBY": "", "HOLDFAST_NATS_NKEY": "a.nk"})
    assert (found.store, found.standby, found.durability) == ("sqlite:a.db", "warm", "fsync")
    assert (found.nats.replicas, found.nats.insecure, found.nats.nkey) == (1, True, str(file.parent / "a.nk"))
    assert found.nats.ca == str(file.parent / "ca.pem")
    over = found.under(store=None, standby="cold", durability=None)
    assert (over.store, over.standby, over.durability) == ("sqlite:a.db", "cold", "fsync")


def test_its_settings_are_those_of_an_access(file: Path) -> None:
    assert {*NatsSettings.__struct_fields__} == {*SETTINGS}
    file.write_text(WHOLE)
    found = read_configuration(file, {})
    assert found.store is not None
    access = access_of(found.store, found.nats.told())
    assert (access.replicas, access.ca) == (3, str(file.parent / "ca.pem"))


@pytest.mark.parametrize(
    ("text", "where", "problem"),
    [
        (
            "a = 1\nstorr = 'x'",
            "line 1",
            "there is no key 'a'; there are store, standby, durability and the table [nats]",
        ),
        ("\nstorr = 'x'", "line 2", "no key 'storr', did you mean 'store'?"),
        ("[nats]\nca = 'x'\ncerts = 'x'", "line 3", "no key 'certs', did you mean 'creds'?"),
        ("store = 'x'\nstandby = 'hot'", "line 2", "standby must be one of 'warm', 'cold', not 'hot'"),
        ("durability = 'disk'", "line 1", "durability must be one of 'memory', 'os', 'fsync', not 'disk'"),
        ("store = 7", "line 1", "store must be a text, not 7"),
        ("store = ''", "line 1", "store must not be empty"),
        ("[nats]\nreplicas = '3'", "line 2", "replicas must be the number 1 or 3, not '3'"),
        ("nats = 3", "line 1", "nats must be a table"),
        ("store = x", "holdfast.toml", "line 1, column"),
    ],
)
def test_what_is_wrong_is_refused_with_file_line_and_key(file: Path, text: str, where: str, problem: str) -> None:
    file.write_text(text)
    with pytest.raises(SpecError) as refused:
        read_configuration(None, {})
    assert str(refused.value).startswith("holdfast.toml")
    assert where in str(refused.value)
    assert problem in str(refused.value)


@pytest.mark.parametrize(
    ("name", "value", "problem"),
    [
        ("HOLDFAST_STANDBY", "hot", "must be one of 'warm', 'cold'"),
        ("HOLDFAST_NATS_REPLICAS", "many", "replicas must be the number 1 or 3, not 'many'"),
        ("HOLDFAST_STOR", "x", "did you mean HOLDFAST_STORE?"),
        ("HOLDFAST_STADNBY", "warm", "did you mean HOLDFAST_STANDBY?"),
        ("HOLDFAST_NAT_NKEY", "x", "did you mean HOLDFAST_NATS_NKEY?"),
        ("HOLDFAST_NATS_CRED", "x", "no key 'cred', did you mean 'creds'?"),
    ],
)
def test_a_wrong_variable_is_refused_by_its_name(file: Path, name: str, value: str, problem: str) -> None:
    with pytest.raises(SpecError) as refused:
        read_configuration(None, {name: value})
    assert str(refused.value).startswith(f"{name}: ")
    assert problem in str(refused.value)


def test_variables_of_others_are_not_ours(file: Path) -> None:
    others = [
        "DATA",
        "KILLS",
        "STORMS",
        "SEED",
        "COLD",
        "STORE_KEY_FILE",
        "SYSTEM",
        "TRACEBACK",
        "FORK_SERVER",
        "STRIKES",
        "ROOTS",
        "RUNS",
        "CUTS",
    ]
    file.write_text("store = 'sqlite:app.db'")
    assert read_configuration(None, {f"HOLDFAST_{one}": "1" for one in others}).store == "sqlite:app.db"


def test_a_mark_before_the_text_is_passed_over(file: Path) -> None:
    file.write_bytes(b"\xef\xbb\xbfstore = 'sqlite:app.db'")
    assert read_configuration(None, {}).store == "sqlite:app.db"


def test_a_pipe_in_the_place_of_the_file_is_refused(file: Path) -> None:
    file.unlink(missing_ok=True)
    os.mkfifo(file, 0o600)
    with pytest.raises(SpecError, match="is no regular file"):
        read_configuration(None, {})


def test_a_named_file_has_to_be_there(file: Path) -> None:
    with pytest.raises(SpecError, match=r"gone\.toml: cannot be read: No such file"):
        read_configuration(None, {"HOLDFAST_CONFIG": "gone.toml"})


def test_a_file_that_others_may_write_to_is_refused(file: Path) -> None:
    file.chmod(0o664)
    with pytest.raises(SpecError, match="somebody else may write to it"):
        read_configuration(None, {})
