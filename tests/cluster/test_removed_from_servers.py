"""Each safety check of servers and their files is there for a reason: take it out, and a test fails.

`HOLDFAST_REMOVED=1 python -m pytest tests/cluster/test_removed_from_servers.py` does so, in a copy; otherwise it is
only looked whether the checks and the tests are where this table says.
"""

from __future__ import annotations

from tests.removing import Check, as_tests

ACCESS = "tests/cluster/test_access.py"
CHECK = "tests/cluster/test_server_check.py"
FILE = "tests/cluster/test_server_file.py"
CONNECTING = "tests/cluster/test_connecting.py"
COPY = "tests/cluster/test_store_copy.py"
GONE = "tests/cluster/test_servers_gone.py"
COMMANDS = "tests/cluster/test_nats_commands.py"
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
    "nothing is sent before a connection is encrypted": Check(
        "cluster/nats/connecting.py",
        "        if not self._is_encrypted:",
        "        if False:",
        CONNECTING,
        "test_nothing_is_sent_to_a_server_without_encryption",
    ),
    "a connection that is made anew is encrypted anew": Check(
        "cluster/nats/connecting.py",
        "        self._is_encrypted = False\n        await super().connect(",
        "        await super().connect(",
        CONNECTING,
        "test_a_server_that_comes_back_without_encryption",
    ),
    "what is encrypted is written by nobody else": Check(
        "cluster/nats/connecting.py",
        "        if self.access.is_encrypted and not isinstance(self._transport, EncryptedTransport):",
        "        if False:",
        CONNECTING,
        "test_nothing_is_sent_to_a_server_without_encryption",
    ),
    "a key of another system is refused": Check(
        "cluster/nats/connecting.py",
        "        if denied:",
        "        if False:",
        CONNECTING,
        "test_each_refusal_has_its_own_words",
    ),
    "a connection that a server has ended is made anew": Check(
        "cluster/nats/connecting.py",
        "        if _STALE in err_msg or _PERMISSIONS in err_msg:",
        "        if True:",
        CONNECTING,
        "test_a_connection_that_a_server_has_ended",
    ),
    "a body that was cancelled stays cancelled": Check(
        "system/system.py",
        "            if self._failure is None and not isinstance(error, asyncio.CancelledError):",
        "            if True:",
        CONNECTING,
        "test_who_is_ended_while_the_servers_are_down",
    ),
    "a start that is cancelled gives the lease up": Check(
        "cluster/joining.py",
        "        await give_up(engine, me)  #",
        "        pass  #",
        CONNECTING,
        "test_a_start_that_is_cancelled",
    ),
    "a start that is cancelled ends what it has begun": Check(
        "system/system.py",
        "            await self.__aexit__(type(error), error, error.__traceback__)\n            raise",
        "            raise",
        CONNECTING,
        "test_a_start_that_is_cancelled",
    ),
    "nothing is said twice": Check(
        "cluster/nats/access.py",
        "    if twice := [name for",
        "    if twice := [][:0] and [name for",
        ACCESS,
        "test_a_wrong_address_is_refused",
    ),
    "a file of credentials has in it what the library reads": Check(
        "cluster/nats/access.py",
        "        if not any(begin in line and after.strip() for line, after in pairwise(lines)):",
        "        if False:",
        ACCESS,
        "test_a_file_of_credentials_has_to_be_one",
    ),
    "a key is read from a regular file": Check(
        "cluster/nats/private_files.py",
        "    if not stat.S_ISREG(info.st_mode):",
        "    if False:",
        ACCESS,
        "test_a_wrong_address_is_refused",
    ),
    "a port serves once": Check(
        "cluster/nats/server_file.py",
        "            if other != this:",
        "            if False:",
        FILE,
        "test_a_plan_that_does_not_work",
    ),
    "a host is one": Check(
        "cluster/nats/server_file.py",
        "        check_host(where, server.host)\n",
        "",
        FILE,
        "test_a_plan_that_does_not_work",
    ),
    "nobody else writes where keys are made": Check(
        "cluster/nats/server_file.py",
        "    _refuse_shared(folder)\n",
        "",
        FILE,
        "test_a_folder_that_others_may_write_to",
    ),
    "a pipe is no configuration": Check(
        "cluster/configuration.py",
        "            if not stat.S_ISREG(info.st_mode):",
        "            if False:",
        CONFIGURATION,
        "test_a_pipe_in_the_place_of_the_file",
    ),
    "a variable that is misspelt is refused": Check(
        "cluster/configuration.py",
        "    _refuse_misspelt(environ)\n",
        "",
        CONFIGURATION,
        "test_a_wrong_variable_is_refused",
    ),
    "what is not there is not copied": Check(
        "cluster/joining.py",
        "        if not is_new and kind ==",
        "        if False and kind ==",
        COPY,
        "test_what_is_not_there_is_not_copied",
    ),
    "a system that is not on the servers is not made to be copied": Check(
        "cluster/nats/nats_engine.py",
        "                    if not is_new:",
        "                    if False:",
        COPY,
        "test_what_is_not_there_is_not_copied",
    ),
    "what is left of a system without its log is no new one": Check(
        "cluster/nats/nats_engine.py",
        "        if lost is not None:",
        "        if False:",
        GONE,
        "what_is_left_of_a_system",
    ),
    "a check tells of a log that is gone": Check(
        "cluster/nats/server_check.py",
        "+ ([lost] if lost is not None else [])",
        "+ []",
        GONE,
        "what_is_left_of_a_system",
    ),
    "a log that was made and not begun is no lost one": Check(
        "cluster/nats/server_check.py",
        "(log.messages or not (log.last_seq or (blobs is not None and blobs.last_seq)))",
        "log.messages",
        GONE,
        "first_start_that_was_cut_off",
    ),
    "a leader whose log is gone ends": Check(
        "cluster/replicated_journal.py",
        "            if gone is not None and misses >= MOST_MISSES:",
        "            if False:",
        GONE,
        "leader_whose_log_is_gone",
    ),
    "a leader whose servers are away is not ready": Check(
        "system/system.py",
        "        silent = None if for_good else self._servers.silent",
        "        silent = None",
        GONE,
        "leader_whose_servers_are_away",
    ),
    "a store that somebody leads is not removed": Check(
        "cluster/nats/store_removal.py",
        "        if await lease.acquire(leader_name()) is None:",
        "        if False:",
        COMMANDS,
        "a_store_is_removed_when_nobody_leads",
    ),
    "a store is removed when that is confirmed": Check(
        "console/nats_commands.py",
        "        if not yes:",
        "        if False:",
        COMMANDS,
        "a_store_is_removed_when_nobody_leads",
    ),
    "a store is not copied to the place of another system": Check(
        "console/store_commands.py",
        "            if theirs and not other_name:",
        "            if False:",
        COMMANDS,
        "not_copied_to_the_place_of_another_system",
    ),
    "a store is not copied into itself": Check(
        "console/store_commands.py",
        "        if is_same_store(source, dest):",
        "        if False:",
        COPY,
        "test_a_store_is_not_copied_into_itself",
    ),
}

test_the_table_is_true, test_somebody_misses_it = as_tests(CHECKS)
