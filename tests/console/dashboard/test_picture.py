"""What is sent are differences: whoever applies them to what he has seen has the rows of the system, in their order."""

from __future__ import annotations

from collections.abc import Iterable

import msgspec
from hypothesis import given
from hypothesis import strategies as st

from holdfast.console.dashboard.picture import Picture, PictureChange, plain
from holdfast.console.overview import ActorRow, ProcessUse, SystemLook


def row(path: str, queued: int = 0, turn: str = "", turn_seconds: float = 0.0) -> ActorRow:
    return ActorRow(path, "m.C", "running", "task", 7, 0, queued, turn, turn_seconds, "", (), (), "permanent", False)


def look(rows: Iterable[ActorRow], seconds: float = 0.0, uses: Iterable[ProcessUse] = ()) -> SystemLook:
    return SystemLook("app", 7, seconds, list(rows), list(uses))


class Page:
    """What a page makes of what it is sent, as live.js does it."""

    def __init__(self, rows: Iterable[ActorRow]) -> None:
        self.children: dict[str, list[str]] = {}
        self.rows: dict[str, ActorRow] = {}
        for one in rows:
            self._put(one, None, is_last=True)

    def apply(self, change: PictureChange) -> None:
        for path in change.gone:
            if self.rows.pop(path, None) is not None:
                self.children[path.rpartition("/")[0]].remove(path)
        for added in change.rows:
            self._put(added.row, added.behind, is_last=False)

    def _put(self, one: ActorRow, behind: str | None, *, is_last: bool) -> None:
        if one.path not in self.rows:
            siblings = self.children.setdefault(one.path.rpartition("/")[0], [])
            siblings.insert(len(siblings) if is_last else siblings.index(behind) + 1 if behind else 0, one.path)
        self.rows[one.path] = one

    def in_order(self) -> list[ActorRow]:
        found, waiting = list[ActorRow](), list(reversed(self.children.get("", [])))
        while waiting:
            path = waiting.pop()
            found.append(self.rows[path])
            waiting.extend(reversed(self.children.get(path, [])))
        return found


def tree(kept: dict[str, dict[str, int]]) -> list[ActorRow]:
    rows = [row("/app")]
    for group, leaves in kept.items():
        rows += [row(f"/app/{group}"), *(row(f"/app/{group}/{name}", queued) for name, queued in leaves.items())]
    return rows


GROUPS = st.dictionaries(st.sampled_from("abc"), st.dictionaries(st.sampled_from("xyz"), st.integers(0, 2)))


@given(st.lists(st.tuples(GROUPS, st.sets(st.sampled_from([f"/app/{g}/{n}" for g in "abc" for n in "xyz"])))))
def test_a_page_that_applies_what_it_is_sent_shows_the_system(
    steps: list[tuple[dict[str, dict[str, int]], set[str]]],
) -> None:
    picture = Picture()
    picture.take(look([row("/app")]), 0.0)
    page = Page([row("/app")])
    for groups, asked in steps:
        rows = tree(groups)
        some = picture.take_some(look(one for one in rows if one.path in asked), asked, 0.0)
        page.apply(some)
        assert page.rows == picture.rows
        change = picture.take(look(rows), 0.0)
        if change is None:
            page = Page(picture.rows.values())
        else:
            page.apply(change)
        assert page.in_order() == rows


def test_what_is_as_it_was_is_not_sent() -> None:
    picture = Picture()
    rows = [row("/app"), row("/app/x", turn="m.Pay", turn_seconds=3.0)]
    picture.take(look(rows), 100.0)
    again = [row("/app"), row("/app/x", turn="m.Pay", turn_seconds=5.1)]
    change = picture.take(look(again), 102.0)
    assert change is not None
    assert change.is_empty
    other = picture.take(look([row("/app"), row("/app/x", turn="m.Pay", turn_seconds=0.5)]), 103.0)
    assert other is not None
    assert [added.row.turn_seconds for added in other.rows] == [102.5]


def test_with_a_supervisor_all_below_it_are_gone() -> None:
    picture = Picture()
    picture.take(look(tree({"a": {"x": 0, "y": 0}, "ab": {"x": 0}})), 0.0)
    change = picture.take_some(look([]), {"/app/a"}, 0.0)
    assert change.gone == ["/app/a", "/app/a/x", "/app/a/y"]


def test_the_use_of_a_processor_is_of_the_time_between_two_looks() -> None:
    picture = Picture()
    first = picture.take(look([row("/app")], 10.0, [ProcessUse(7, 50_000_000, 1.0)]), 0.0)
    soon = picture.take(look([row("/app")], 10.5, [ProcessUse(7, 60_000_000, 1.4)]), 0.0)
    later = picture.take(look([row("/app")], 12.0, [ProcessUse(7, 60_000_000, 1.5)]), 0.0)
    assert first is not None
    assert soon is not None
    assert later is not None
    assert first.processes is not None
    assert first.processes[0].cpu_percent is None
    assert soon.processes is None
    assert later.processes is not None
    assert later.processes[0].cpu_percent == 25.0


def test_what_json_has_no_word_for_is_text() -> None:
    assert msgspec.json.decode(plain({"x": object})) == {"x": "<class 'object'>"}
    assert msgspec.json.decode(plain("no \u202eelbuort, but ümlaute")) == "no ⟨U+202E⟩elbuort, but ümlaute"
