"""`holdfast top`: a running system on one page, again each second, with keys to look closer and to change it."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Coroutine
from typing import Any, ClassVar

from rich.style import Style
from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.screen import ModalScreen
from textual.widgets import Footer, Input, Static

from ...actors.errors import HoldfastError
from ..overview import ActorRow, SystemLook
from ..remote import NotReached, RemoteSystem
from .looking import COLOURS, inspection_lines
from .losses import held_up_by, lost_by
from .patterns import select
from .row_list import RowList

COLUMNS = ("actor", "state", "class", "place", "queued", "turns/s", "restarts", "MB", "cpu %", "recovery", "mechanism")
MOST_ROWS = 500
"""Actors on the page; a pattern chooses among more."""
MOST_COUNTED = 100
"""Actors from the top of the page whose turns are counted."""
NUMBERS = frozenset({"queued", "turns/s", "restarts", "MB", "cpu %"})
STYLES = {state: Style.parse(colour) for state, colour in COLOURS.items()}
SORTS = ("tree", "queued", "turns/s", "restarts")


class Page(ModalScreen[None]):
    """Text to read; any of the keys closes it."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape,q,i,enter", "dismiss", "Close")]
    CSS = "Page { align: center middle; } Page VerticalScroll { width: 80%; height: 80%; border: round $primary; }"

    def __init__(self, text: str) -> None:
        super().__init__()
        self._text = text

    def compose(self) -> ComposeResult:
        with VerticalScroll():
            yield Static(self._text, markup=False)


class Question(ModalScreen[bool]):
    """A question to be answered by y or n."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("y", "answer(True)", "Yes"),
        Binding("n,escape,q", "answer(False)", "No"),
    ]
    CSS = "Question { align: center middle; } Question Static { width: 60%; border: round $warning; padding: 1 2; }"

    def __init__(self, text: str) -> None:
        super().__init__()
        self._text = text

    def compose(self) -> ComposeResult:
        yield Static(f"{self._text}\n\ny: go on, n: leave it", markup=False)

    def action_answer(self, answer: bool) -> None:
        """Close the question with the answer."""
        self.dismiss(answer)


class Top(App[str]):
    """The page. It returns why it has ended, if not by a key."""

    CSS = "RowList { height: 1fr; } #head { height: 1; } #pattern { display: none; }"
    ENABLE_COMMAND_PALETTE = False
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("s", "order('suspend')", "Suspend"),
        Binding("r", "order('resume')", "Resume"),
        Binding("R", "restart", "Restart", key_display="R"),
        Binding("i,enter", "inspect", "Inspect", priority=False),
        Binding("o", "sort", "Order"),
        Binding("slash", "pattern", "Pattern", key_display="/"),
        Binding("q", "quit", "Quit"),
    ]

    def __init__(self, remote: RemoteSystem, *, seconds: float = 1.0, patterns: tuple[str, ...] = ()) -> None:
        super().__init__()
        self._remote, self._seconds, self._patterns = remote, seconds, patterns
        self._look: SystemLook | None = None
        self._turns: dict[str, int] = {}
        self._rates: dict[str, float] = {}
        self._sort = SORTS[0]
        self._is_asking = False

    def compose(self) -> ComposeResult:
        yield Static("", id="head", markup=False)
        yield RowList(COLUMNS, NUMBERS, style_of)
        yield Input(placeholder="/app/**[restarts>3]", id="pattern")
        yield Footer()

    def on_mount(self) -> None:
        """Look at once, and then again and again."""
        self._rows().focus()
        self.set_interval(self._seconds, self.look_again)
        self.call_later(self.look_again)

    def _rows(self) -> RowList:
        return self.query_one(RowList)

    # -- looking ------------------------------------------------------------------------------------------------------

    async def look_again(self) -> None:
        """Ask the system, and show what is different. While an answer is out nobody asks again."""
        if self._is_asking:
            return
        self._is_asking = True
        try:
            look = await asyncio.to_thread(self._remote.look)
            rows = self._chosen(look)
            counted = [row.path for row in rows[:MOST_COUNTED] if row.pid]
            turns = await asyncio.to_thread(self._remote.count_turns, counted)
        except NotReached as error:
            self.exit(str(error))
            return
        except HoldfastError as error:
            self.notify(str(error), severity="error")
            return
        finally:
            self._is_asking = False
        self._show(look, rows, turns)

    def _chosen(self, look: SystemLook) -> list[ActorRow]:
        rows = look.rows
        if self._patterns:
            with contextlib.suppress(HoldfastError):
                rows = select(rows, self._patterns)
        return sorted(rows, key=self._place_of)[:MOST_ROWS] if self._sort != "tree" else rows[:MOST_ROWS]

    def _place_of(self, row: ActorRow) -> float:
        """What the rows are ordered by: the most comes first."""
        found = {"queued": row.queued, "restarts": row.restarts, "turns/s": self._rates.get(row.path, 0.0)}
        return -found[self._sort]

    def _show(self, look: SystemLook, rows: list[ActorRow], turns: dict[str, int]) -> None:
        before, self._look = self._look, look
        seconds = look.seconds - before.seconds if before is not None else 0.0
        self._rates = {
            path: (count - self._turns[path]) / seconds
            for path, count in turns.items()
            if seconds > 0 and path in self._turns and count >= self._turns[path]
        }
        self._turns = turns
        processes = self._processes(look, before, seconds)
        self._rows().show_rows({row.path: self._cells(row, processes) for row in rows})
        more = "" if len(look.rows) == len(rows) else f" ({len(rows)} shown)"
        waiting = sum(row.queued for row in look.rows)
        odd = sum(row.state != "running" for row in look.rows)
        head = f"{look.system} (pid {look.pid}): {len(look.rows)} actors{more}, {odd} not running, {waiting} wait"
        self.query_one("#head", Static).update(f"{head}; {sum(self._rates.values()):.0f} turns/s; by {self._sort}")

    @staticmethod
    def _processes(look: SystemLook, before: SystemLook | None, seconds: float) -> dict[int, tuple[str, str]]:
        """Of each process its memory, and the share of one processor that it has used since the last time."""
        used = {use.pid: use.cpu_seconds for use in before.processes} if before is not None else {}
        return {
            use.pid: (
                f"{use.memory_bytes / 1e6:.0f}",
                f"{100 * (use.cpu_seconds - used[use.pid]) / seconds:.0f}" if use.pid in used and seconds > 0 else "",
            )
            for use in look.processes
        }

    def _cells(self, row: ActorRow, processes: dict[int, tuple[str, str]]) -> tuple[str, ...]:
        depth = row.path.count("/") - 1
        name = "  " * depth + row.path.rpartition("/")[2] if self._sort == "tree" and not self._patterns else row.path
        memory, cpu = processes.get(row.pid, ("", "")) if row.place != "task" or depth == 0 else ("", "")
        rate = self._rates.get(row.path)
        return (
            name,
            row.state,
            row.kind.rpartition(".")[2],
            f"{row.place} {row.pid}" if row.place != "task" and row.pid else row.place,
            str(row.queued),
            "" if rate is None else f"{rate:.0f}",
            str(row.restarts),
            memory,
            cpu,
            row.recovery,
            " + ".join(row.mechanism),
        )

    # -- keys ---------------------------------------------------------------------------------------------------------

    def action_inspect(self) -> None:
        """Show all there is to say of the actor at the cursor."""
        self._begin(self._inspect(self._rows().key_at_cursor))

    async def _inspect(self, path: str) -> None:
        found = await asyncio.to_thread(self._remote.inspect, path)
        self.push_screen(Page("\n".join(inspection_lines(found))))

    def action_order(self, verb: str) -> None:
        """Suspend or resume the actor at the cursor; asks if that holds up many."""
        path, look = self._rows().key_at_cursor, self._look
        if look is None or not path:
            return
        held = held_up_by([row for row in look.rows if row.path == path], look.rows) if verb == "suspend" else []
        self._ask(f"{verb} {path}", held, lambda: self._order(verb, path))

    async def _order(self, verb: str, path: str) -> None:
        async with self._remote.transaction() as change:
            change.suspend(path) if verb == "suspend" else change.resume(path)
        self.notify(f"{verb} {path}: done", markup=False)
        await self.look_again()

    def action_restart(self) -> None:
        """Restart the actor at the cursor; asks if its state would be lost."""
        path, look = self._rows().key_at_cursor, self._look
        if look is None or not path:
            return
        lost = lost_by([row for row in look.rows if row.path == path], look.rows)
        self._ask(f"restart {path}", lost, lambda: self._restart(path))

    def _ask(self, what: str, lost: list[str], work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Do something at once if nothing speaks against it, else when the answer is yes."""

        def answered(yes: bool | None) -> None:
            if yes:
                self._begin(work())

        if lost:
            self.push_screen(Question(f"{what}: {'; '.join(lost)}"), answered)
        else:
            answered(True)

    async def _restart(self, path: str) -> None:
        await self._remote.restart(path)
        self.notify(f"restart {path}: done", markup=False)
        await self.look_again()

    def action_sort(self) -> None:
        """Take the next order of the rows."""
        self._sort = SORTS[(SORTS.index(self._sort) + 1) % len(SORTS)]
        self._begin(self.look_again())

    def action_pattern(self) -> None:
        """Show the field for a pattern, and type there."""
        field = self.query_one("#pattern", Input)
        field.styles.display = "block"
        field.focus()

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """A pattern was given, or an empty one for all."""
        event.input.styles.display = "none"
        self._rows().focus()
        text = event.value.strip()
        try:
            if text and self._look is not None:
                select(self._look.rows, [text])
        except HoldfastError as error:
            self.notify(str(error), severity="error", markup=False)
            return
        self._patterns = (text,) if text else ()
        self._begin(self.look_again())

    def _begin(self, work: Any) -> None:
        """Do what takes a while; an error is shown, and the page goes on."""

        async def done() -> None:
            try:
                await work
            except HoldfastError as error:
                self.notify(str(error), severity="error", markup=False)

        self.run_worker(done(), exit_on_error=False)


def style_of(column: str, text: str) -> Style | None:
    """The style of a cell: states have colours."""
    return STYLES.get(text, STYLES["restarting"]) if column == "state" else None
