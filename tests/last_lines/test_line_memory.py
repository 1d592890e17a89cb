"""The memory of last lines keeps within its bounds, and a follower is told of every line that it did not get."""

import itertools
import random

import pytest

from holdfast.system.history.ring import GoneNumbers
from holdfast.system.last_lines.line_memory import ADDRESS_BYTES, LineLimits, LineMemory
from holdfast.system.last_lines.line_page import LogPage, answer_lines, log_question

SMALL = LineLimits(characters=200, lines=20, address_bytes=8_000, addresses=10, all_bytes=60_000)


def memory(limits: LineLimits = SMALL) -> LineMemory:
    """A memory whose clock goes on by a second with each line."""
    return LineMemory(map(float, itertools.count(1)).__next__, limits)


def asked(lines: LineMemory, path: str = "**", *, after: int | None = None, **more: object) -> LogPage:
    return answer_lines(lines, log_question(path, after=after, **more))  # type: ignore[arg-type]  # by name, as given


def texts(page: LogPage) -> list[str]:
    return [line.text for line in page.lines]


@pytest.mark.parametrize("seed", range(5))
def test_it_keeps_the_newest_within_its_bounds(seed: int) -> None:
    chance, lines = random.Random(seed), memory()
    told: dict[str, list[str]] = {}
    for number in range(2_000):
        address = f"/app/{min(chance.randrange(15), chance.randrange(15))}"
        text = f"{number} {'x' * chance.choice([0, 10, 190])}"
        told.setdefault(address, []).append(text)
        lines.add(address, "stdout", "info", text, 1)
        assert lines.bytes <= SMALL.all_bytes
        assert len(lines._rings) <= SMALL.addresses
        assert lines.bytes == sum(ring.bytes + ADDRESS_BYTES for ring in lines._rings.values())
    for address, said in told.items():
        kept = texts(asked(lines, address))
        assert len(kept) <= SMALL.lines
        assert kept == said[len(said) - len(kept) :]


def test_who_prints_much_does_not_drive_out_who_prints_little() -> None:
    lines = memory()
    lines.add("/app/quiet", "stdout", "info", "here I am")
    for number in range(1_000):
        lines.add(f"/app/loud{number % 8}", "stdout", "info", f"{number} {'x' * 180}")
    assert texts(asked(lines, "/app/quiet")) == ["here I am"]
    assert all(texts(asked(lines, f"/app/loud{number}")) for number in range(8))


def test_a_long_line_is_kept_with_its_beginning_and_its_end() -> None:
    lines = memory()
    lines.add("/app/one", "stdout", "info", "a" * 5_000 + "z" * 5_000)
    [text] = texts(asked(lines))
    assert (text[:3], text[-3:], len(text) < 300) == ("aaa", "zzz", True)


@pytest.mark.parametrize("path", ["**", "/app/1", "/app/[12]"])
@pytest.mark.parametrize("at_once", [1, 30])
@pytest.mark.parametrize("seed", range(3))
def test_whoever_follows_gets_each_line_or_is_told_of_it(path: str, at_once: int, seed: int) -> None:
    """Exactly if lines come as they are read, many of one process; else rather too many are counted."""
    chance, lines = random.Random(seed), memory(LineLimits(lines=20, address_bytes=8_000, all_bytes=1_000_000))
    meant, after, got, dropped = list[int](), 0, list[str](), 0
    address = ""
    for number in range(3_000):
        if number % at_once == 0:
            address = chance.choice(["/app/1", "/app/1", "/app/2", "/app/3"])
        lines.add(address, "stdout", "info", str(number))
        if path == "**" or address[-1] in path:
            meant.append(number)
        if chance.random() < 0.03 or number == 2_999:
            for _ in range(1 if number < 2_999 else 100):
                page = asked(lines, path, after=after, limit=chance.choice([3, 10, 1000]))
                after, got, dropped = page.next, got + texts(page), dropped + page.dropped
    assert after == lines.last
    assert got == sorted(got, key=int)
    assert set(map(int, got)) <= set(meant)
    assert dropped
    assert len(got) + dropped >= len(meant)
    if at_once > 1:
        assert len(got) + dropped == len(meant)


def test_of_addresses_that_are_forgotten_it_is_told_that_there_were_lines() -> None:
    lines = memory()
    for number in range(30):
        lines.add(f"/app/{number}", "stdout", "info", str(number))
    page = asked(lines, after=0)
    assert len(page.lines) + page.dropped == 30
    assert asked(lines, after=page.next).dropped == 0


def test_older_runs_become_one_and_none_is_forgotten() -> None:
    gone = GoneNumbers()
    for number in range(0, 200, 2):
        gone.add(number)
    assert (gone.count, gone.after(-1), gone.after(198)) == (100, 100, 0)
    assert gone.after(191) == 4
    assert all(gone.after(number) >= sum(one > number for one in range(0, 200, 2)) for number in range(200))


def test_lines_are_chosen_by_level_time_and_number() -> None:
    lines = memory()
    lines.add_printed("/app/one", "stdout", "out", 1)
    lines.add_printed("/app/one", "stderr", "err", 1)
    lines.add("/app/one", "holdfast", "error", "actor crashed", 1)
    assert texts(asked(lines)) == ["out", "err", "actor crashed"]
    assert texts(asked(lines, level="warning")) == ["err", "actor crashed"]
    assert texts(asked(lines, level="critical")) == []
    assert texts(asked(lines, since=2.0)) == ["err", "actor crashed"]
    assert texts(asked(lines, limit=1)) == ["actor crashed"]
    assert texts(asked(lines, after=1, limit=1)) == ["err"]
    assert len(asked(lines, after=1_000).lines) == 3, "it is a number of the program before this one"


def test_the_lines_of_replicas_are_those_of_the_actor() -> None:
    lines = memory()
    lines.add("/app/till/ftm/r1", "stdout", "info", "by a replica")
    lines.add("/app/till/other", "stdout", "info", "by a child")
    assert texts(asked(lines, "/app/till")) == ["by a replica"]
    assert texts(asked(lines, "/app/*")) == ["by a replica"]
    assert texts(asked(lines, "/app/till/**")) == ["by a replica", "by a child"]
