"""Each safety check of servers and their files is there for a reason: take it out, and a test fails.

`HOLDFAST_REMOVED=1 python -m pytest tests/cluster/test_removed_from_servers.py` does so, in a copy; otherwise it is
only looked whether the checks and the tests are where this table says.
"""

from __future__ import annotations

from tests.removing import Check, as_tests

ACCESS = "tests/cluster/test_access.py"
CHECK = "tests/cluster/test_server_check.py"
FILE = "tests/cluster/test_server_file.py"
CONFIGURATION = "tests/cluster/test_configuration.py"

CHECKS = {
    "servers on other machines are reached with TLS": Check(
        "cluster/nats/access.py",
        "    if far and not access.is_encrypted and not access.insecure:",
        "    if False:",
        ACCESS,
        "test_a_wrong_address_is_refused",
    ),
    "an address with a password is not repeated": Check(
        "cluster/nats/access.py",
        '    return f"...@{tail}" if at else store',
        "    return store",
        ACCESS,
        "test_no_password_of_an_address_is_repeated",
    ),
    "a key in place of its file is not repeated": Check(
        "cluster/nats/access.py",
        "    if _SEED.fullmatch(told):",
        "    if False:",
        ACCESS,
        "test_a_key_in_place_of_its_file",
    ),
    "two replicas are refused": Check(
        "cluster/nats/access.py",
        '    if str(told) not in ("1", "3"):',
        "    if False:",
        ACCESS,
        "test_a_wrong_address_is_refused",
    ),
    "nobody else may read a file of secrets": Check(
        "cluster/nats/private_files.py",
        "        if info.st_mode & (stat.S_IRWXG | stat.S_IRWXO):",
        "        if False:",
        ACCESS,
        "test_a_file_of_secrets_that_others_may_read",
    ),
    "records are on the disk before they are acknowledged": Check(
        "cluster/nats/server_file.py",
        "sync_interval: always #",
        "sync_interval: 2m #",
        CHECK,
        "test_a_server_of_our_own_configuration",
    ),
    "a server that acknowledges too early is refused": Check(
        "cluster/nats/server_check.py",
        "    if not server.jetstream.config.sync_always:",
        "    if False:",
        CHECK,
        "test_a_server_that_is_fast_and_loose",
    ),
    "an old server is refused": Check(
        "cluster/nats/server_check.py",
        "    if _version(server.version) < OLDEST:",
        "    if False:",
        CHECK,
        "test_each_wrong_setting_is_one_problem",
    ),
    "a start is refused where something may be lost": Check(
        "cluster/nats/server_check.py",
        "    if fatal:",
        "    if False:",
        CHECK,
        "test_a_server_that_is_fast_and_loose",
    ),
    "a client hears its own answers only": Check(
        "cluster/nats/server_file.py",
        '    own = f"{inbox_of(user.key)}.>"',
        '    own = "_INBOX.>"',
        FILE,
        "test_a_role_may_do",
    ),
    "a client may not append to a log": Check(
        "cluster/nats/server_file.py",
        '            return Permissions((f"hf.{system}.*.in", f"hf.{system}.node.*.*.>"), (own,))',
        "            return Permissions((everything,), (own,))",
        FILE,
        "test_a_role_may_do",
    ),
    "a server that others reach needs a certificate": Check(
        "cluster/nats/server_file.py",
        "        if server.tls is None and not is_loopback(server.host):",
        "        if False:",
        FILE,
        "test_a_plan_that_does_not_work",
    ),
    "who connects shows a certificate": Check(
        "cluster/nats/server_file.py",
        "verify: true #",
        "verify: false #",
        FILE,
        "test_servers_with_certificates_are_used_with_one_only",
    ),
    "a server file that was changed by hand is kept": Check(
        "cluster/nats/server_file.py",
        "    if not force and",
        "    if False and",
        FILE,
        "test_a_file_that_may_have_been_changed_by_hand",
    ),
    "nobody else says where a program keeps things": Check(
        "cluster/configuration.py",
        "            if info.st_uid not in (0, os.geteuid()) or info.st_mode & (stat.S_IWGRP | stat.S_IWOTH):",
        "            if False:",
        CONFIGURATION,
        "test_a_file_that_others_may_write_to",
    ),
}

test_the_table_is_true, test_somebody_misses_it = as_tests(CHECKS)
