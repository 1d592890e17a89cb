"""The page in a real Chromium, as its user has it: each view, each order, the keyboard alone, dark, light and narrow.

`HOLDFAST_PICTURES=docs/pictures` has the pictures of docs/dashboard.md taken anew, into that folder.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, Playwright, expect, sync_playwright

from tests.console.dashboard.ailing import EVIL_NAME, EVIL_TEXT
from tests.console.dashboard.served import OPERATORS, READERS

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed: apt-get install chromium")
ROOT = Path(__file__).resolve().parents[3]
PATIENCE = 30_000
"""Milliseconds that nothing here takes, unless something is wrong."""
VIEWS = ("", "diagnosis", "letters", "events", "changes", "metrics", "actor/app/shop/clerk")
EXPECTED = ("net::ERR_", "status of 409", "requires 'TrustedHTML'")
"""What a browser writes down beside faults: a server that has gone, an answer that is no, a trap that has worked."""
PICTURES = os.environ.get("HOLDFAST_PICTURES", "")
EVIL = f"/app/shop/{EVIL_NAME}"
expect.set_options(timeout=PATIENCE)


@pytest.fixture(autouse=True)
def nothing_left() -> None:
    """Leave the processes of what is served, which come and go there: that none of them stays is seen at the end."""


class Served:
    """A system with its dashboard in a process of its own."""

    def __init__(self, *args: str) -> None:
        command = [sys.executable, "-m", "tests.console.dashboard.served", *args]
        self._process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        self.url = self._process.stdout.readline().strip()
        assert self.url, "the program has ended"

    def tell(self, path: str, what: str) -> None:
        """Have an actor do something."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{path} {what}\n")
        self._process.stdin.flush()

    def end(self) -> None:
        """Have the program end, in good order."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    """A system of two thousand actors."""
    one = Served("2000")
    yield one
    one.end()


@pytest.fixture(scope="module")
def playwright() -> Iterator[Playwright]:
    """The driver of the browser."""
    with sync_playwright() as running:
        yield running


@pytest.fixture(scope="module")
def browser(playwright: Playwright) -> Iterator[Browser]:
    """One browser for all tests."""
    one = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
    yield one
    one.close()


class Visit:
    """A browser's visit, of which nothing that is written down is an error, nor anything evil has run."""

    def __init__(self, browser: Browser) -> None:
        self.errors: list[str] = []
        self.context = browser.new_context(
            viewport={"width": 1280, "height": 800}, color_scheme="light", reduced_motion="reduce"
        )
        self.context.set_default_timeout(PATIENCE)
        self.context.on("console", self._hear)
        self.context.on("weberror", lambda error: self.errors.append(str(error.error)))

    def _hear(self, message: ConsoleMessage) -> None:
        if message.type == "error" and not any(words in message.text for words in EXPECTED):
            self.errors.append(message.text)

    def check(self) -> None:
        """Nothing went wrong so far."""
        assert [page.evaluate("window.evil") for page in self.context.pages] == [None] * len(self.context.pages)
        assert self.errors == []


@pytest.fixture
def context(browser: Browser) -> Iterator[BrowserContext]:
    """A browser that has visited nothing so far."""
    visit = Visit(browser)
    yield visit.context
    visit.check()
    visit.context.close()


@pytest.fixture(scope="module")
def visit(browser: Browser, served: Served) -> Iterator[Visit]:
    """An operator with one page open."""
    one = Visit(browser)
    opened(one.context, served.url)
    yield one
    one.context.close()


@pytest.fixture
def page(visit: Visit) -> Iterator[Page]:
    """The page of an operator, at its first view."""
    [one] = visit.context.pages
    at(one, "")
    expect(one.get_by_role("treeitem").first).to_be_visible()
    yield one
    visit.check()


def opened(context: BrowserContext, url: str, token: str = OPERATORS) -> Page:
    one = context.new_page()
    one.goto(f"{url}#token={token}")
    expect(one.locator("#system")).to_have_text("/app")
    return one


def at(page: Page, view: str) -> None:
    page.evaluate("view => { location.hash = '#/' + view; }", view)


def picture(page: Page, name: str) -> None:
    if PICTURES:
        page.evaluate("document.getElementById('notes').replaceChildren()")
        page.screenshot(path=ROOT / PICTURES / f"dashboard-{name}.png")


def verb(page: Page, name: str) -> None:
    page.locator(f"main button[data-verb={name}]").first.click()


def confirm(page: Page, words: str) -> None:
    """What is asked before something is lost, in the words of the command line; the answer is yes."""
    expect(page.locator("dialog li")).to_contain_text(words)
    page.get_by_role("button", name="Go on").click()


def trouble(page: Page, path: str) -> object:
    return page.locator("article", has=page.locator("h3 a").get_by_text(path, exact=True))


def test_the_token_is_in_no_address_and_the_cookie_in_no_script(context: BrowserContext, served: Served) -> None:
    page = opened(context, served.url)
    assert "token" not in page.url
    assert page.evaluate("document.cookie") == ""
    [cookie] = context.cookies()
    assert (cookie.get("httpOnly"), cookie.get("sameSite")) == (True, "Strict")
    page.reload()
    expect(page.locator("#system")).to_have_text("/app")


def test_one_logs_in_by_hand_and_out_again(context: BrowserContext, served: Served) -> None:
    page = context.new_page()
    page.goto(f"{served.url}#token={OPERATORS}")
    expect(page.locator("#system")).to_have_text("/app")
    page.get_by_role("link", name="Log out").click()
    expect(page.get_by_label("Token")).to_be_focused()


def test_what_is_ill_comes_first_and_says_why_and_what_to_do(page: Page, served: Served) -> None:
    served.tell("/app/shop/till", "wait")
    bank, till = page.locator("#attention article").all_inner_texts() or ["", ""]  # at the beginning there is none
    assert (bank, till) == ("", "")
    bank_card = page.locator("article.ill", has_text="await asyncio.Event().wait()")
    expect(bank_card).to_contain_text("/app/shop/bank has been in the turn of")
    expect(bank_card).to_contain_text("Put a time limit around this line.")
    till_card = page.locator("article.led")
    expect(till_card).to_contain_text("because of /app/shop/bank, it seems")
    expect(page.locator("#summary")).to_have_text("2010 actors, 2 need attention")
    picture(page, "frozen")
    page.emulate_media(color_scheme="dark")
    page.set_viewport_size({"width": 400, "height": 800})
    picture(page, "narrow")
    page.emulate_media(color_scheme="light")
    page.set_viewport_size({"width": 1280, "height": 800})
    bank_card.get_by_role("button", name="Kill the turn").click()
    confirm(page, "without recovery, the state is lost of /app/shop/bank")
    expect(page.locator("article.led")).to_have_count(0)
    bank_card.locator("h3 a")
    expect(page.locator("details.news summary")).to_contain_text("nothing to do")


def test_a_message_in_quarantine_is_dropped_when_one_says_so(page: Page, served: Served) -> None:
    served.tell("/app/shop/fragile", "die")
    card = page.locator("article.ill", has_text="/app/shop/fragile")
    expect(card).to_contain_text("was put into quarantine")
    expect(page.locator("#put-aside")).to_have_text(" 1")
    at(page, "letters")
    expect(page.locator("main td a").first).to_have_text("/app/shop/fragile")
    verb(page, "quarantine-drop")
    expect(page.locator("dialog li")).to_contain_text("this is dropped:")
    page.get_by_role("button", name="Cancel").click()
    expect(page.locator("#put-aside")).to_have_text(" 1")
    verb(page, "quarantine-retry")
    confirm(page, "and its supervisor give up")
    expect(page.locator("main td", has_text="2 tests.console").first).to_be_visible()  # It has ended the process again.
    verb(page, "quarantine-drop")
    confirm(page, "this is dropped:")
    expect(page.get_by_text("Nothing is in quarantine.")).to_be_visible()
    expect(page.locator("main section").last.locator("td", has_text="DeadLetter")).to_be_visible()


def test_an_actor_is_suspended_resumed_stopped_and_started(page: Page) -> None:
    at(page, "actor/app/shop/clerk")
    state = page.locator("main .chip").first
    expect(state).to_have_text("running")
    verb(page, "suspend")
    expect(state).to_have_text("suspended")
    expect(page.locator("main section").first).to_contain_text(
        "by an operator: it handles nothing, and what comes waits for `resume`."
    )
    verb(page, "resume")
    expect(state).to_have_text("running")
    verb(page, "stop")
    page.get_by_role("button", name="Cancel").click()
    expect(state).to_have_text("running")
    verb(page, "stop")
    confirm(page, "without recovery, the state is lost of /app/shop/clerk")
    expect(state).to_have_text("stopped")
    verb(page, "start")
    expect(state).to_have_text("running")
    verb(page, "restart")
    confirm(page, "without recovery, the state is lost of /app/shop/clerk")
    expect(page.locator("main .chip", has_text="restart")).to_be_visible()
    expect(page.locator("main section", has_text="Lives and recoveries")).to_contain_text("by an operator")


def test_a_state_is_shown_saved_and_its_messages_are_followed(page: Page, served: Served) -> None:
    at(page, "actor/app/shop/ledger?state")
    states = page.locator("main section", has=page.get_by_role("heading", name="State", exact=True))
    expect(states).to_contain_text("done")
    expect(states).to_contain_text(EVIL_TEXT)
    verb(page, "checkpoint")
    expect(page.locator("#notes")).to_contain_text("saved /app/shop/ledger")
    verb(page, "trace")
    log = page.get_by_role("log", name="Messages")
    expect(log).to_have_text("Nothing yet.")
    served.tell("/app/shop/ledger", "work")
    expect(log).to_contain_text("ended Work")
    page.get_by_role("button", name="Stop following").click()


def test_the_last_lines_of_an_actor_are_shown_as_text(page: Page, served: Served) -> None:
    served.tell("/app/shop/fragile", "print")
    at(page, "actor/app/shop/fragile")
    lines = page.get_by_role("log", name="Last lines")
    text = re.escape(f" stdout: {EVIL_TEXT} \\x1b[31m")
    expect(lines).to_contain_text(re.compile(rf"life \d+{text}"))  # Other tests may have ended lives before.
    expect(page.locator("main b")).to_have_count(0)
    at(page, "actor/app/shop/ledger")
    expect(page.get_by_role("log", name="Last lines")).to_have_text("No line of it is kept.")


def test_bindings_are_changed(page: Page) -> None:
    at(page, "actor/app/shop/till")
    ties = page.locator("main section", has=page.get_by_role("heading", name="Ties"))
    verb(page, "unbind")
    expect(ties).not_to_contain_text("binding bank")
    verb(page, "bind")
    page.get_by_label("Port").fill("bank")
    page.get_by_label("Target").fill("/app/shop/clerk")
    page.keyboard.press("Enter")
    expect(ties.get_by_role("link", name="/app/shop/clerk")).to_be_visible()


def test_a_protected_actor_shows_its_replicas(page: Page) -> None:
    at(page, "actor/app/safe")
    drawn = page.get_by_role("img", name=re.compile(r"pbr, whole, epoch 1"))
    expect(drawn).to_contain_text("r1 leads")
    expect(drawn).to_contain_text("after: Checkpointing")
    page.set_viewport_size({"width": 1280, "height": 960})
    picture(page, "actor")
    page.set_viewport_size({"width": 1280, "height": 800})
    verb(page, "protect")
    expect(page.get_by_label("Mechanisms, outermost first")).to_have_value("pbr")
    page.keyboard.press("Escape")


TREE = 'below = "/app/crowd/group0"\n["/app/crowd/group0"]\nsupervisor = "one_for_one"\nintensity = 9\nperiod = 10.0\n'


def test_a_tree_is_planned_and_what_was_changed_is_listed(page: Page) -> None:
    at(page, "changes")
    expect(page.locator("main td", has_text="add /app/shop/")).to_be_visible()
    page.get_by_label("The tree that is wanted, in TOML").fill(TREE)
    verb(page, "plan")
    expect(page.locator(".steps").first).to_contain_text("set intensity=9, period=10.0 of /app/crowd/group0")
    expect(page.locator(".diff")).to_contain_text("+ /app/crowd/group0: Supervisor")
    verb(page, "apply")
    confirm(page, "without recovery, the state is lost of /app/crowd/group0/leaf0")
    expect(page.locator("main td", has_text="set intensity=9")).to_be_visible()
    page.get_by_label("The tree that is wanted, in TOML").fill("below =")
    verb(page, "plan")
    expect(page.locator(".note.ill")).to_contain_text("the page")


def test_events_are_chosen_and_followed(page: Page, served: Served) -> None:
    at(page, "events")
    rows = page.locator("main tr")
    expect(rows.first).to_be_visible()
    page.get_by_label("Kind of event").fill("ActorCrashed")
    page.get_by_label("Addresses").fill("/app/shop/clerk")
    page.get_by_role("button", name="Show").click()
    served.tell("/app/shop/clerk", "raise")
    expect(page.locator("main td", has_text="ActorCrashed").first).to_be_visible()
    expect(page.locator("main td", has_text="ActorStarted")).to_have_count(0)


def test_metrics_are_drawn(page: Page) -> None:
    at(page, "metrics")
    expect(page.locator(".plot", has_text="actors").first.locator("path.spark")).to_have_count(1)
    expect(page.locator(".plot", has_text="/app (pid").first).to_contain_text("MB")


def test_what_actors_call_themselves_and_say_is_text(page: Page, served: Served) -> None:
    served.tell(EVIL, "raise")
    card = page.locator("article", has_text=EVIL_NAME)
    expect(card).to_contain_text(f"RuntimeError: {EVIL_TEXT}")
    card.locator("h3 a").click()
    expect(page.locator("h1")).to_contain_text(EVIL_NAME)
    expect(page.locator("main section", has_text="Lives and recoveries")).to_contain_text(EVIL_TEXT)
    expect(page.locator("main img, main script, main b")).to_have_count(0)
    at(page, "events")
    expect(page.locator("main td", has_text=EVIL_NAME).first).to_be_visible()
    verbs = "el => { el.innerHTML = '<img src=x onerror=window.evil=3>'; }"
    with pytest.raises(Exception, match="TrustedHTML"):  # Not even by a fault of the page can text become HTML.
        page.locator("main").evaluate(verbs)


def test_of_two_thousand_actors_few_are_elements(page: Page) -> None:
    expect(page.get_by_role("treeitem").first).to_be_visible()
    page.get_by_role("button", name="Expand").click()
    tree = page.get_by_role("tree")
    height = tree.evaluate("tree => tree.firstElementChild.offsetHeight")
    assert height > 1800 * 28
    seen: set[str] = set()
    for part in range(6):
        tree.evaluate("(tree, top) => { tree.scrollTop = top; }", part * height // 5)
        page.evaluate("() => new Promise(requestAnimationFrame)")
        page.evaluate("() => new Promise(requestAnimationFrame)")
        assert page.locator(".row").count() <= 200
        seen.update(page.locator(".row:visible a").all_inner_texts())
    assert "leaf98" in seen
    page.get_by_role("button", name="Collapse").click()


def test_everything_is_reached_by_the_keyboard_alone(page: Page) -> None:
    at(page, "events")
    expect(page.locator("main h1")).to_have_text("Events")
    page.keyboard.press("/")
    search = page.get_by_role("searchbox")
    expect(search).to_be_focused()
    page.keyboard.type("clerk")
    at_row = page.locator(".row.at")
    expect(at_row).to_contain_text("clerk")
    page.keyboard.press("Enter")
    tree = page.get_by_role("tree")
    expect(tree).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.locator("h1")).to_have_text("/app/shop/clerk")
    page.keyboard.press("Escape")
    expect(search).to_have_value("clerk")
    search.focus()
    page.keyboard.press("Escape")
    expect(search).to_have_value("")
    expect(tree).to_be_focused()
    page.keyboard.press("Home")
    expect(at_row).to_have_attribute("aria-level", "1")
    page.keyboard.press("ArrowDown")
    expect(at_row).to_contain_text("shop")
    for _ in range(2):  # It may be open already.
        page.keyboard.press("ArrowLeft")
    page.keyboard.press("Home")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Home")
    page.keyboard.press("ArrowRight")
    expect(at_row).to_contain_text("shop")
    expect(at_row).to_have_attribute("aria-expanded", "false")
    page.keyboard.press("ArrowRight")
    expect(at_row).to_have_attribute("aria-expanded", "true")
    page.keyboard.press("ArrowRight")
    expect(at_row).to_contain_text("bank")
    assert tree.get_attribute("aria-activedescendant") == at_row.get_attribute("id")
    page.keyboard.press("ArrowLeft")
    expect(at_row).to_contain_text("shop")
    page.keyboard.press("End")
    expect(at_row).to_contain_text("crowd")
    page.keyboard.press("Enter")
    expect(page.locator("h1")).to_have_text("/app/crowd")
    expect(page.locator("main")).to_be_focused()
    page.keyboard.press("Tab")
    for _ in range(40):  # From the head of the page to an order: each step shows where one is.
        focus = page.evaluate("getComputedStyle(document.activeElement).outlineStyle")
        assert focus != "none"
        if page.evaluate("document.activeElement.dataset.verb") == "suspend":
            break
        page.keyboard.press("Tab")
    else:
        raise AssertionError("no order was reached")
    page.keyboard.press("Enter")
    expect(page.locator("dialog")).to_contain_text("while /app/crowd is suspended")
    expect(page.get_by_role("button", name="Cancel")).to_be_focused()
    page.keyboard.press("Escape")
    expect(page.locator("dialog")).to_be_hidden()


def test_a_pattern_of_the_command_line_chooses(page: Page) -> None:
    search = page.get_by_role("searchbox")
    search.fill("/app/shop/**[kind=Worker, recovery=hybrid]")
    expect(page.locator(".bar [role=status]")).to_have_text(re.compile(r"2 of \d+ actors"))
    search.fill("/app/[x>1]")
    expect(page.locator(".bar [role=status]")).to_contain_text("there is no field 'x'")
    context_errors = page.locator(".row")
    expect(context_errors.first).to_be_hidden()
    search.fill("")


def test_it_is_dark_and_light_and_narrow(context: BrowserContext, served: Served) -> None:
    page = opened(context, served.url)
    shade = "getComputedStyle(document.body).backgroundColor"
    light = page.evaluate(shade)
    page.emulate_media(color_scheme="dark")
    dark = page.evaluate(shade)
    assert dark != light
    page.get_by_title("Dark or light").click()
    assert page.evaluate(shade) == light
    page.reload()
    expect(page.locator("#system")).to_have_text("/app")
    assert page.evaluate(shade) == light  # It was chosen, and is kept.
    page.get_by_title("Dark or light").click()
    page.set_viewport_size({"width": 400, "height": 800})
    for view in VIEWS:
        at(page, view)
        expect(page.locator("main")).not_to_contain_text("Loading…")
        expect(page.locator("main h1, main .tree").first).to_be_visible()
        assert page.evaluate("document.documentElement.scrollWidth") <= 400, view
        assert page.locator("main").evaluate("main => main.scrollWidth - main.clientWidth") <= 0, view
    at(page, "")
    expect(page.get_by_role("treeitem").first).to_be_visible()


def test_who_may_look_sees_no_orders_and_no_states(context: BrowserContext, served: Served) -> None:
    page = opened(context, served.url, READERS)
    at(page, "actor/app/shop/clerk")
    expect(page.locator("main section").first).to_contain_text("/app/shop/clerk")
    expect(page.locator("main button:visible")).to_have_count(0)
    expect(page.get_by_role("heading", name="State", exact=True)).to_be_hidden()
    at(page, "changes")
    expect(page.locator("main textarea")).to_have_count(0)
    expect(page.locator("main td").first).to_be_visible()


def test_a_plan_of_repair_is_approved(context: BrowserContext) -> None:
    other = Served("0", "diagnosis")
    try:
        page = opened(context, other.url)
        other.tell("/app/shop/clerk", "hang")
        card = page.locator("article", has=page.get_by_role("button", name="Approve case"))
        expect(card).to_contain_text("restart_child(shop/clerk)")
        at(page, "diagnosis")
        expect(page.get_by_role("img", name=re.compile("symptoms"))).to_be_visible()
        expect(page.get_by_role("img", name=re.compile("steps of a case"))).to_be_visible()
        picture(page, "diagnosis")
        verb(page, "repair-approve")
        expect(page.locator("main")).not_to_contain_text("waits for a yes")
        page.get_by_label("How far repair goes").select_option("advise")
        expect(page.locator("#notes")).to_contain_text("repair set advise")
        page.close()
    finally:
        other.end()


def test_a_dashboard_that_has_gone_is_told(context: BrowserContext) -> None:
    """What is shown is what was; a browser writes down each attempt that fails, which is no error of the page."""
    other = Served("0")
    page = opened(context, other.url)
    page.route("**/*", lambda route: route.abort())
    other.end()
    expect(page.get_by_role("alert").first).to_contain_text("what is shown is how it was")
    page.close()
