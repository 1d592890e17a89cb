"""Each safety check of the dashboard is there for a reason: take it out, and a test fails.

`HOLDFAST_REMOVED=1 python -m pytest tests/console/dashboard/test_removed_from_dashboard.py` does so, in a copy;
otherwise it is only looked whether the checks and the tests are where this table says.
"""

from __future__ import annotations

from tests.removing import Check, as_tests

ACCESS = "tests/console/dashboard/test_access.py"
GATHERING = "tests/console/dashboard/test_gathering.py"
ORDERS = "tests/console/dashboard/test_orders.py"
PICTURE = "tests/console/dashboard/test_picture.py"
TROUBLES = "tests/console/dashboard/test_troubles.py"
FOLDER = "console/dashboard/"

CHECKS = {
    "nothing is told without a login": Check(
        f"{FOLDER}access.py",
        "        if not self.is_known(connection):",
        "        if False:",
        ACCESS,
        "test_without_a_token",
    ),
    "a login ends": Check(
        f"{FOLDER}access.py",
        "login is not None and time.monotonic() <= login.until",
        "login is not None",
        ACCESS,
        "test_a_login_ends",
    ),
    "who logs out is forgotten": Check(
        f"{FOLDER}web_app.py",
        "            self._access.log_out(request)\n",
        "",
        ACCESS,
        "test_who_has_logged_out",
    ),
    "a wrong token is none": Check(
        f"{FOLDER}access.py",
        "        if not roles:\n",
        "        if False:\n",
        ACCESS,
        "test_without_a_token",
    ),
    "tokens are not guessed": Check(
        f"{FOLDER}access.py",
        "        if len(self._wrong) >= MOST_WRONG:",
        "        if False:",
        ACCESS,
        "test_tokens_are_not_guessed_fast",
    ),
    "readers change nothing": Check(
        f"{FOLDER}access.py",
        '    if needed == "operate" and login.role != "operate":',
        "    if False:",
        ACCESS,
        "test_who_may_look_may_not_change",
    ),
    "states are for operators": Check(
        f"{FOLDER}web_app.py",
        "            check_role(login, self._state_role)\n            question",
        "            question",
        ACCESS,
        "test_states_and_messages",
    ),
    "messages are for operators": Check(
        f"{FOLDER}web_app.py",
        "        check_role(login, self._state_role)\n        over",
        "        over",
        ACCESS,
        "test_states_and_messages",
    ),
    "the cookie is hidden from scripts": Check(
        f"{FOLDER}web_app.py",
        'httponly=True, samesite="strict"',
        'httponly=False, samesite="strict"',
        ACCESS,
        "test_a_token_is_exchanged",
    ),
    "the cookie is for this site": Check(
        f"{FOLDER}web_app.py",
        'httponly=True, samesite="strict"',
        'httponly=True, samesite="lax"',
        ACCESS,
        "test_a_token_is_exchanged",
    ),
    "the cookie goes over TLS only": Check(
        f"{FOLDER}web_app.py",
        'is_secure = request.url.scheme == "https"',
        "is_secure = False",
        ACCESS,
        "test_a_token_is_exchanged",
    ),
    "only the page itself asks": Check(
        f"{FOLDER}web_app.py",
        '            if request.method != "GET":\n                self._access.check_page(request, login)\n',
        "",
        ACCESS,
        "test_what_the_page_itself_has_not_sent",
    ),
    "another origin is refused": Check(
        f"{FOLDER}access.py",
        "if origin is not None and urlsplit(origin).netloc.lower() != host:",
        "if False:",
        ACCESS,
        "test_another_page_may_not_ask",
    ),
    "a browser's word for another site is heard": Check(
        f"{FOLDER}access.py",
        'if connection.headers.get("sec-fetch-site", "none") not in ("same-origin", "none"):',
        "if False:",
        ACCESS,
        "test_another_page_may_not_ask",
    ),
    "a name that was bound to us is refused": Check(
        f"{FOLDER}access.py",
        "        if host not in self._hosts and _without_port(host) not in self._hosts:",
        "        if False:",
        ACCESS,
        "test_a_name_that_is_not_ours",
    ),
    "a request is JSON": Check(
        f"{FOLDER}web_app.py",
        'if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":',
        "if False:",
        ACCESS,
        "test_a_request_is_json_and_small",
    ),
    "a request is small": Check(
        f"{FOLDER}web_app.py",
        "        if len(body) > MOST_BYTES:",
        "        if False:",
        ACCESS,
        "test_a_request_is_json_and_small",
    ),
    "no file outside of the page is served": Check(
        f"{FOLDER}web_app.py",
        "        if file.parent != PAGE or file.suffix not in KINDS or not file.is_file():",
        "        if not file.is_file():",
        ACCESS,
        "test_only_the_files_of_the_page",
    ),
    "each answer restrains the browser": Check(
        f"{FOLDER}web_app.py",
        "await self._app(scope, receive, send_safely)",
        "await self._app(scope, receive, send)",
        ACCESS,
        "test_each_answer_says",
    ),
    "others may not read a token": Check(
        f"{FOLDER}access.py",
        "if info.st_uid != os.geteuid() or info.st_mode & (stat.S_IRWXG | stat.S_IRWXO):",
        "if False:",
        ACCESS,
        "test_a_token_comes_from_a_file",
    ),
    "a token is made for its user alone": Check(
        f"{FOLDER}access.py",
        "os.open(file, flags, 0o600)",
        "os.open(file, flags, 0o644)",
        ACCESS,
        "test_a_token_comes_from_a_file",
    ),
    "a token is long": Check(
        f"{FOLDER}access.py",
        "if len(token) < SHORTEST or",
        "if",
        ACCESS,
        "test_a_dashboard_without_tokens",
    ),
    "both roles need tokens of their own": Check(
        f"{FOLDER}access.py",
        "        if len(set(tokens.values())) < len(tokens):",
        "        if False:",
        ACCESS,
        "test_a_dashboard_without_tokens",
    ),
    "without TLS it is for this machine": Check(
        f"{FOLDER}serving.py",
        "    if not is_loopback(host) and certfile is None and not insecure:",
        "    if False:",
        ACCESS,
        "test_others_reach_it_with_tls_only",
    ),
    "the loop of the system is not touched from elsewhere": Check(
        f"{FOLDER}answers.py",
        "        if not self._system._node.is_own_thread():",
        "        if False:",
        ACCESS,
        "test_a_system_on_another_loop",
    ),
    "who is far behind is dropped": Check(
        f"{FOLDER}gathering.py",
        "        if len(self._pending) >= MOST_PENDING:",
        "        if False:",
        GATHERING,
        "test_who_does_not_read_is_dropped",
    ),
    "who takes nothing is dropped": Check(
        f"{FOLDER}web_app.py",
        "            message = await viewer.next()\n            async with asyncio.timeout(UNREAD):",
        "            message = await viewer.next()\n            async with asyncio.timeout(None):",
        GATHERING,
        "test_a_stream_that_takes_nothing",
    ),
    "there are so many viewers": Check(
        f"{FOLDER}gathering.py",
        "        if len(self._viewers) >= MOST_VIEWERS:",
        "        if False:",
        GATHERING,
        "test_there_are_so_many_viewers",
    ),
    "nothing is gathered when nobody looks": Check(
        f"{FOLDER}gathering.py",
        "        if not self._viewers:\n            await self._end()",
        "        if False:\n            await self._end()",
        GATHERING,
        "test_five_viewers",
    ),
    "what only looks is asked again": Check(
        f"{FOLDER}answers.py",
        "                    if isinstance(request, CHANGES):\n                        raise",
        "                    raise",
        GATHERING,
        "test_a_connection_that_was_closed",
    ),
    "what was done is looked at when it is over": Check(
        f"{FOLDER}gathering.py",
        "_has_changed |= any(event.kind in CHANGING for event in page.events)",
        "_has_changed |= False",
        GATHERING,
        "test_another_order_is_a_new_picture",
    ),
    "parts of the runtime are not shown": Check(
        "console/overview.py",
        "        if parts or one.cell is None or not is_part(one.cell):",
        "        if True:",
        GATHERING,
        "test_parts_of_the_runtime",
    ),
    "it is asked before something is lost": Check(
        f"{FOLDER}orders.py",
        "    if warnings and not order.is_confirmed and not order.is_dry_run:",
        "    if False:",
        ORDERS,
        "test_a_restart_warns or test_the_root_is_asked_about",
    ),
    "it is asked before a tree loses something": Check(
        f"{FOLDER}orders.py",
        "    if lost and not order.is_confirmed:",
        "    if False:",
        ORDERS,
        "test_a_tree_is_planned",
    ),
    "a plan changes nothing": Check(
        f"{FOLDER}orders.py",
        "    if order.is_dry_run or not plan.steps:",
        "    if not plan.steps:",
        ORDERS,
        "test_a_tree_is_planned",
    ),
    "mechanisms from the page are names": Check(
        f"{FOLDER}orders.py",
        "            if not all(MECHANISM.fullmatch(name) for name in names):",
        "            if False:",
        ORDERS,
        "test_protect_takes_names",
    ),
    "an order is an operator's": Check(
        "console/client_session.py",
        "        ACTING.set(OPERATOR)  # In the context of the task of this request.\n",
        "",
        ORDERS,
        "test_an_order_is_an_operators",
    ),
    "an order is for so many": Check(
        f"{FOLDER}orders.py",
        "    if len(order.paths) > MOST_PATHS:",
        "    if False:",
        ORDERS,
        "test_an_order_is_for_so_many",
    ),
    "another order of children is a new picture": Check(
        f"{FOLDER}picture.py",
        "        return None if is_moved else PictureChange",
        "        return PictureChange",
        PICTURE,
        "test_a_page_that_applies",
    ),
    "what only grows with time is no change": Check(
        f"{FOLDER}picture.py",
        "abs(known.turn_seconds - began) < SAME_TURN",
        "False",
        PICTURE,
        "test_what_is_as_it_was",
    ),
    "a turn that goes on and on is suspicious": Check(
        f"{FOLDER}troubles.py",
        "    if row.turn and seen.now - row.turn_seconds >= LONG_TURN:\n        return 4.0",
        "    if False:\n        return 4.0",
        TROUBLES,
        "test_who_looks_ill_is_asked",
    ),
    "what concerns all is said once": Check(
        f"{FOLDER}troubles.py",
        "    return path == seen.root or _is_own(one)",
        "    return True",
        TROUBLES,
        "test_what_concerns_all",
    ),
    "a fault that nobody follows is grave": Check(
        f"{FOLDER}troubles.py",
        'case "its own faults" if not is_there:',
        'case "its own faults" if False:',
        TROUBLES,
        "test_a_fault_is_graver",
    ),
}

test_the_table_is_true, test_without_the_check_a_test_fails = as_tests(CHECKS)
