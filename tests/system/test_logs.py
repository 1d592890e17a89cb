"""What an operator reads: a crash with its traceback, and floods limited and counted (DESIGN 9, otp.md W13)."""

import asyncio
import logging
import subprocess
import sys
from collections.abc import Iterator, MutableMapping
from itertools import count
from typing import Any

import pytest
import structlog

import holdfast as hf

pytestmark = pytest.mark.asyncio(loop_factories=["virtual"])
Record = MutableMapping[str, Any]
NUMBERS = count()


class Boom(hf.Message):
    text: str = "boom"


class Ping(hf.Message[str]): ...


class Stillborn(hf.Actor):
    def on_start(self, restored: bool) -> None:
        raise OSError("no device")


class Draws(hf.Actor):
    """Gives another reply each time: its replay diverges."""

    @hf.on(Ping)
    def ping(self, message: Ping) -> str:
        return f"{next(NUMBERS)}"


class Silent(hf.Actor):
    """Says nothing of what it was given."""

    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError

    @hf.on(Ping)
    def ping(self, message: Ping) -> str:
        return "pong"


class Fragile(hf.Actor):
    @hf.on(Boom)
    def boom(self, message: Boom) -> None:
        raise ValueError(message.text)

    @hf.on(Ping)
    def ping(self, message: Ping) -> str:
        return "pong"


@pytest.fixture
def records() -> Iterator[list[Record]]:
    with structlog.testing.capture_logs() as captured:
        yield captured


def of(records: list[Record], event: str) -> list[Record]:
    return [record for record in records if record["event"] == event]


async def test_a_crash_is_logged_with_its_traceback(records: list[Record]) -> None:
    async with hf.ActorSystem("shop") as system:
        ref = await system.start(hf.child("fragile", hf.start(Fragile)))
        ref.tell(Boom("the glass fell"))
        assert await ref.ask(Ping()) == "pong"
    (crash,) = of(records, "actor crashed")
    assert (crash["log_level"], crash["system"], crash["address"]) == ("error", "shop", "/shop/fragile")
    assert crash["reason"] == "ValueError: the glass fell"
    assert crash["message"].endswith("test_logs.Boom")
    assert crash["exception"].startswith("Traceback (most recent call last):")
    assert "raise ValueError(message.text)" in crash["exception"]
    assert (crash["restarts"], crash["allowed"]) == (0, 3)
    assert len(records) == 1


async def test_the_text_of_an_error_steers_no_terminal(records: list[Record]) -> None:
    async with hf.ActorSystem("shop") as system:
        ref = await system.start(hf.child("fragile", hf.start(Fragile)))
        ref.tell(Boom("\x1b[2Jgone\r\x07, in\ntwo lines"))
        assert await ref.ask(Ping()) == "pong"
    (crash,) = of(records, "actor crashed")
    assert crash["reason"] == "ValueError: \\x1b[2Jgone\\x0d\\x07, in\ntwo lines"
    assert "\x1b" not in crash["exception"]
    assert "\\x1b[2Jgone" in crash["exception"]


async def test_each_crash_has_one_record_and_it_counts_the_restarts(records: list[Record]) -> None:
    async with hf.ActorSystem() as system:
        top = hf.supervisor("top", intensity=1, restart="temporary", children=[hf.child("x", hf.start(Fragile))])
        await system.start(top)
        fragile = system.ref("/app/top/x", Fragile)
        for _ in range(2):
            fragile.tell(Boom())
            await system._node.settled()
    crashes = of(records, "actor crashed")
    assert [(crash["restarts"], crash["allowed"]) for crash in crashes] == [(0, 1), (1, 1)]
    assert ["exception" in record for record in records] == [True, True, False]
    assert records[-1]["event"] == "supervisor gave up"


async def test_a_crash_that_no_supervisor_sees_is_logged_all_the_same(records: list[Record]) -> None:
    async with hf.ActorSystem() as system:
        system.spawn(hf.start(Fragile), "alone").tell(Boom())
        await system._node.settled()
        await asyncio.sleep(2.0)  # of the virtual clock
        (crash,) = records
    assert (crash["event"], crash["address"]) == ("actor crashed", "/app/alone")
    assert "restarts" not in crash


async def test_a_child_that_cannot_start_has_one_record_with_the_traceback(records: list[Record]) -> None:
    async with hf.ActorSystem() as system:
        with pytest.raises(hf.StartFailed):
            await system.start(hf.child("stillborn", hf.start(Stillborn)))
    (record,) = records
    assert (record["event"], record["log_level"], record["message"]) == ("child not started", "error", "on_start")
    assert "no device" in record["exception"]


async def test_a_child_whose_class_its_process_cannot_import_is_logged_with_that_reason(
    records: list[Record],
) -> None:
    here = type("Here", (Fragile,), {"__module__": "__main__"})
    sys.modules["__main__"].Here = here  # type: ignore[attr-defined]  # as a cell of a notebook does
    async with hf.ActorSystem() as system:
        with pytest.raises(hf.StartFailed) as failed:
            await system.start(hf.child("here", hf.start(here), isolation="process"))
    (record,) = records
    assert (record["event"], record["reason"]) == ("child not started", failed.value.reason)


async def test_a_recovery_that_fails_has_one_record_for_each_attempt(records: list[Record]) -> None:
    async with hf.ActorSystem(intensity=1000) as system:
        ref = await system.start(hf.child("draws", hf.start(Draws), recovery=hf.hybrid(), backoff=hf.Backoff()))
        await ref.ask(Ping())
        with system.events() as stream:
            ref.kill()
            for _ in range(3):
                await stream.until(hf.events.ChildStartFailed)
        attempts = [record["event"] for record in records if record["event"] != "child ended"]
        assert attempts == ["recovery failed"] * 3
    assert all("diverged at turn 1" in record["reason"] for record in of(records, "recovery failed"))


async def test_a_recorded_actor_that_crashes_as_it_starts_has_its_traceback_told_with_the_start(
    records: list[Record],
) -> None:
    async with hf.ActorSystem() as system:
        with pytest.raises(hf.StartFailed):
            await system.start(hf.child("stillborn", hf.start(Stillborn), recovery=hf.hybrid()))
    assert [record["event"] for record in records] == ["child not started"]
    assert "exception" in records[0]


@pytest.mark.parametrize("log_payloads", [False, True])
async def test_what_is_in_a_message_is_logged_only_if_asked_for(records: list[Record], log_payloads: bool) -> None:
    async with hf.ActorSystem(log_payloads=log_payloads) as system:
        ref = await system.start(hf.child("fragile", hf.start(Silent)))
        ref.tell(Boom("secret"))
        assert await ref.ask(Ping()) == "pong"
    (crash,) = of(records, "actor crashed")
    assert ("secret" in repr(crash)) == ("payload" in crash) == log_payloads


class FromStandard(logging.Handler):
    """Keeps the records of standard logging."""

    def __init__(self) -> None:
        super().__init__()
        self.records: list[logging.LogRecord] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.records.append(record)


@pytest.fixture
def standard() -> Iterator[FromStandard]:
    """A program that has set up standard logging, and never heard of structlog."""
    logger, handler = logging.getLogger("holdfast"), FromStandard()
    logger.addHandler(handler)
    yield handler
    logger.removeHandler(handler)


async def test_standard_logging_gets_the_record_where_structlog_is_not_set_up(standard: FromStandard) -> None:
    async with hf.ActorSystem("shop") as system:
        ref = await system.start(hf.child("fragile", hf.start(Fragile)))
        ref.tell(Boom("100 % gone"))
        assert await ref.ask(Ping()) == "pong"
    (record,) = standard.records
    assert (record.levelno, record.name) == (logging.ERROR, "holdfast")
    assert record.getMessage().startswith("actor crashed address='/shop/fragile'")
    assert "reason='ValueError: 100 % gone'" in record.getMessage()
    shown = logging.Formatter().format(record)
    assert shown.count("Traceback (most recent call last):") == 1
    assert shown.endswith("ValueError: 100 % gone")
    assert vars(record)["holdfast"]["restarts"] == 0


async def test_a_program_that_has_set_up_nothing_gets_its_log_on_stderr() -> None:
    program = """
import asyncio, holdfast as hf

class Boom(hf.Message): ...

class Fragile(hf.Actor):
    @hf.on(Boom)
    def boom(self, message): raise ValueError("boom")

async def main():
    async with hf.ActorSystem("app") as system:
        ref = await system.start(hf.child("one", hf.start(Fragile)))
        with system.events() as events:
            ref.tell(Boom())
            async for event in events:
                if isinstance(event, hf.events.ChildRestarted): break
    print("done")

asyncio.run(main())
"""
    argv = [sys.executable, "-c", program]
    done = subprocess.run(argv, check=False, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, "done\n")
    assert "actor crashed" in done.stderr


async def test_standard_logging_decides_which_levels_are_seen(standard: FromStandard) -> None:
    logging.getLogger("holdfast").setLevel(logging.CRITICAL)
    try:
        async with hf.ActorSystem() as system:
            system.spawn(hf.start(Fragile), "fragile").tell(Boom())
            await system._node.settled()
    finally:
        logging.getLogger("holdfast").setLevel(logging.NOTSET)
    assert standard.records == []


async def test_a_supervisor_that_gives_up_is_logged_as_an_error(records: list[Record]) -> None:
    async with hf.ActorSystem() as system:
        top = hf.supervisor("top", intensity=0, restart="temporary", children=[hf.child("x", hf.start(Fragile))])
        await system.start(top)
        system.ref("/app/top/x", Fragile).tell(Boom())
        await system._node.settled()
    (gave_up,) = of(records, "supervisor gave up")
    assert (gave_up["log_level"], gave_up["address"], gave_up["child"]) == ("error", "/app/top", "x")


async def test_a_message_to_the_dead_is_logged_by_its_type(records: list[Record]) -> None:
    async with hf.ActorSystem() as system:
        ref = system.spawn(hf.start(Fragile), "fragile")
        await system.stop(ref)
        ref.tell(Boom("secret"))
    (letter,) = of(records, "dead letter")
    assert letter["message"].endswith("test_logs.Boom")
    assert letter["address"] == "/app/fragile"
    assert "secret" not in repr(letter)  # what is in a message is nobody's business


async def test_a_flood_is_limited_within_a_second_and_what_is_left_out_is_counted(records: list[Record]) -> None:
    async with hf.ActorSystem() as system:
        gone = [system.spawn(hf.start(Fragile)) for _ in range(116)]
        for ref in gone:
            await system.stop(ref)
        for ref in gone[:100]:
            ref.tell(Boom())
        assert len(of(records, "dead letter")) == 10
        await asyncio.sleep(1.0)
        for ref in gone[100:115]:
            ref.tell(Boom())
        await asyncio.sleep(5.0)
        gone[-1].tell(Boom())
        assert system.dead_letters == 116
    letters = of(records, "dead letter")
    assert [letter.get("left_out", 0) for letter in letters] == [0] * 10 + [90] + [0] * 9 + [5]
    assert len(letters) + sum(letter.get("left_out", 0) for letter in letters) == 116


async def test_a_mailbox_that_drops_all_day_warns_once_in_a_while(records: list[Record]) -> None:
    async with hf.ActorSystem() as system:
        full = hf.child("camera", hf.start(Fragile), mailbox=hf.bounded(1, overflow="latest"))
        ref = await system.start(full)
        await system.suspend(ref)
        for _ in range(301):  # for half a minute
            ref.tell(Boom())
            await asyncio.sleep(0.1)
        other = system.spawn(hf.start(Fragile), "other")
        await system.stop(other)
        other.tell(Boom())
        letters = of(records, "dead letter")
        assert system.dead_letters == 301
    assert [letter["address"] for letter in letters] == ["/app/camera"] * 3 + ["/app/other"]
    assert [round(letter.get("alike", 0), -1) for letter in letters] == [0, 100, 100, 0]


async def test_a_flood_of_one_kind_hides_no_other(records: list[Record]) -> None:
    async with hf.ActorSystem() as system:
        gone = system.spawn(hf.start(Fragile))
        await system.stop(gone)
        for _ in range(100):
            gone.tell(Boom())
        system.spawn(hf.start(Fragile), "late").tell(Boom())
        await system._node.settled()
    assert [crash["address"] for crash in of(records, "actor crashed")] == ["/app/late"]


async def test_log_false_is_silent(records: list[Record]) -> None:
    async with hf.ActorSystem(log=False) as system:
        system.spawn(hf.start(Fragile)).tell(Boom())
        await system._node.settled()
    assert records == []


class Kept(hf.Actor):
    def __init__(self) -> None:
        self.pings = 0

    @hf.on(Ping)
    def ping(self, message: Ping) -> str:
        self.pings += 1
        return "pong"


def kept(count: int) -> list[hf.ChildSpec]:
    return [hf.child(f"k{n}", hf.start(Kept), recovery=hf.hybrid()) for n in range(count)]


async def test_a_subtree_that_recovers_has_one_record_with_the_numbers(records: list[Record]) -> None:
    async with hf.ActorSystem() as system:
        inner = hf.supervisor("inner", children=kept(20))
        await system.start(hf.supervisor("outer", children=[inner, *kept(10)], intensity=0))
        for above, number in (("/app/outer/inner", 20), ("/app/outer", 10)):
            for n in range(number):
                await system.ref(f"{above}/k{n}", Kept).ask(Ping())
        system.ref("/app/outer", hf.Supervisor).kill()
        await asyncio.sleep(5.0)  # of the virtual clock
        (together,) = of(records, "actors recovered")
    assert (together["address"], together["actors"], together["replayed"]) == (
        "/app/outer",
        30,
        60,
    )  # the start of each, and its message
    assert together["slowest"].startswith("/app/outer/")
    assert together["seconds"] >= 0.0
    assert not of(records, "actor recovered")


async def test_actors_that_recover_one_by_one_have_a_record_each(records: list[Record]) -> None:
    async with hf.ActorSystem() as system:
        refs = [await system.start(spec) for spec in kept(2)]
        for ref in refs:
            ref.kill()
            await asyncio.sleep(5.0)  # of the virtual clock
        assert [record["address"] for record in of(records, "actor recovered")] == ["/app/k0", "/app/k1"]


async def test_siblings_that_recover_together_have_one_record_also_at_the_end(records: list[Record]) -> None:
    async with hf.ActorSystem() as system:
        refs = [await system.start(spec) for spec in kept(3)]
        for ref in refs:
            ref.kill()
            await ref.ask(Ping())
    (together,) = of(records, "actors recovered")
    assert (together["address"], together["actors"], together["log_level"]) == ("/app", 3, "info")


@pytest.mark.asyncio(loop_factories=["uvloop"])
@pytest.mark.parametrize("how", ["taken away", "stopped"])
async def test_replicas_that_are_not_wanted_any_more_do_not_die(records: list[Record], how: str) -> None:
    async with hf.ActorSystem("shop") as system:
        ref = await system.start(hf.child("silent", hf.start(Silent), mechanism=hf.ftm.PBR()))
        with system.events() as events:
            if how == "stopped":
                await system.stop(ref)
            else:
                async with system.transaction() as change:
                    change.protect(ref, None)
                assert await ref.ask(Ping()) == "pong"
            ended = [await events.until(hf.events.ProcessDied) for _ in range(2)]
    assert [str(event.reason) for event in ended] == ["shutdown", "shutdown"]
    assert not [record for record in records if record["log_level"] in ("warning", "error")]
