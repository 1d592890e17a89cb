"""A dashboard of a running system in the process of the test."""

from collections.abc import AsyncIterator

import pytest

import holdfast as hf
from holdfast.console.dashboard import Dashboard, dashboard
from tests.console.dashboard.conversing import OPERATORS, READERS, Browser


@pytest.fixture
async def app(system: hf.ActorSystem) -> AsyncIterator[Dashboard]:
    """The dashboard of the system of the tests of the command line."""
    made = dashboard(system, operators=OPERATORS, readers=READERS)
    yield made
    await made.close()


@pytest.fixture
async def operator(app: Dashboard) -> AsyncIterator[Browser]:
    """Somebody who may change the system."""
    browser = Browser(app)
    assert (await browser.log_in(OPERATORS)).is_success
    yield browser
    await browser.http.aclose()


@pytest.fixture
async def reader(app: Dashboard) -> AsyncIterator[Browser]:
    """Somebody who may only look."""
    browser = Browser(app)
    assert (await browser.log_in(READERS)).is_success
    yield browser
    await browser.http.aclose()
