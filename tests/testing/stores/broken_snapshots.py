"""Engines whose snapshots are lost or mixed up, or do not belong to the entries behind them."""

from __future__ import annotations

from collections.abc import Sequence

from holdfast.checkpoint.journal import Saved
from tests.checkpoint.one_file import Contents, OneFile
from tests.testing.stores.broken_writes import WritesAtClose

Drop = Sequence[int] | range


class MoreThanACut(OneFile):
    """Changes something else in a second write behind a cut."""

    def spoil(self, contents: Contents, address: str, drop: Drop) -> None:
        """Change what else the store has."""

    def cut(self, address: str, snapshot: bytes, drop: Drop, *, turn: int, keep: int = 2) -> None:
        super().cut(address, snapshot, drop, turn=turn, keep=keep)
        with self._changing() as contents:
            self.spoil(contents, address, drop)


class CutInTwoWrites(OneFile):
    """Forgets entries in one write, and keeps the snapshot in the next."""

    def cut(self, address: str, snapshot: bytes, drop: Drop, *, turn: int, keep: int = 2) -> None:
        if keep == 1:
            with self._changing() as contents:
                known = contents.entries.get(address, {})
                contents.entries[address] = {at: entry for at, entry in known.items() if at not in set(drop)}
        super().cut(address, snapshot, drop, turn=turn, keep=keep)


class DropInASecondWrite(OneFile):
    """Keeps the snapshot in one write, and forgets what it contains in the next: a kill between doubles it."""

    def cut(self, address: str, snapshot: bytes, drop: Drop, *, turn: int, keep: int = 2) -> None:
        super().cut(address, snapshot, (), turn=turn, keep=keep)
        with self._changing() as contents:
            data, after, contained = contents.snapshots[address][-1]
            known = contents.entries[address]
            contents.snapshots[address][-1] = (data, after, contained | known.keys() & set(drop))
            gone = contents.snapshots[address][0][2]
            contents.entries[address] = {at: entry for at, entry in known.items() if at not in gone}


class OlderOnesInMemory(WritesAtClose):
    """Has older snapshots in memory alone, until it is closed."""

    def leave_out(self, contents: Contents) -> None:
        contents.snapshots = {address: kept[-1:] for address, kept in contents.snapshots.items()}


class IgnoresRanges(OneFile):
    """Ignores `drop` when it is a range."""

    def cut(self, address: str, snapshot: bytes, drop: Drop, *, turn: int, keep: int = 2) -> None:
        super().cut(address, snapshot, [] if isinstance(drop, range) else drop, turn=turn, keep=keep)


class IgnoresSteps(OneFile):
    """Takes a range with a step for one without."""

    def cut(self, address: str, snapshot: bytes, drop: Drop, *, turn: int, keep: int = 2) -> None:
        whole = range(drop.start, drop.stop) if isinstance(drop, range) else drop
        super().cut(address, snapshot, whole, turn=turn, keep=keep)


class DropsOfAllAddresses(MoreThanACut):
    """Forgets the positions in `drop` whosever they are."""

    def spoil(self, contents: Contents, address: str, drop: Drop) -> None:
        for other, known in contents.entries.items():
            if other != address:
                contents.entries[other] = {at: entry for at, entry in known.items() if at not in set(drop)}


class DropsUpTo(OneFile):
    """Takes `drop` for everything up to its highest position."""

    def cut(self, address: str, snapshot: bytes, drop: Drop, *, turn: int, keep: int = 2) -> None:
        known = self._contents.entries.get(address, {})
        below = [position for position in known if drop and position <= max(drop)]
        super().cut(address, snapshot, below, turn=turn, keep=keep)


class DropsWhatIsToCome(MoreThanACut):
    """Remembers positions in `drop` that nobody has yet, and drops them when they come."""

    def spoil(self, contents: Contents, address: str, drop: Drop) -> None:
        data, after, contained = contents.snapshots[address][-1]
        contents.snapshots[address][-1] = (data, after, contained | set(drop))


class DropsEverything(OneFile):
    """Takes a snapshot to contain every entry."""

    def cut(self, address: str, snapshot: bytes, drop: Drop, *, turn: int, keep: int = 2) -> None:
        super().cut(address, snapshot, list(self._contents.entries.get(address, {})), turn=turn, keep=keep)


class DropsTheFirstAlone(OneFile):
    """Drops a run of positions, as far as they follow each other."""

    def cut(self, address: str, snapshot: bytes, drop: Drop, *, turn: int, keep: int = 2) -> None:
        known = list(drop)
        super().cut(address, snapshot, range(known[0], known[0] + len(known)) if known else (), turn=turn, keep=keep)


class KeepsOneFewer(OneFile):
    """Keeps one snapshot fewer than it is asked for."""

    def cut(self, address: str, snapshot: bytes, drop: Drop, *, turn: int, keep: int = 2) -> None:
        super().cut(address, snapshot, drop, turn=turn, keep=max(1, keep - 1))


class KeepsOneMore(OneFile):
    """Keeps one snapshot more than it is asked for."""

    def cut(self, address: str, snapshot: bytes, drop: Drop, *, turn: int, keep: int = 2) -> None:
        super().cut(address, snapshot, drop, turn=turn, keep=keep + 1)


class KeepsTwo(OneFile):
    """Keeps two snapshots, whatever it is asked for."""

    def cut(self, address: str, snapshot: bytes, drop: Drop, *, turn: int, keep: int = 2) -> None:
        super().cut(address, snapshot, drop, turn=turn)


class OldestOfAll(OneFile):
    """Goes back to the oldest snapshot, however far it is asked to."""

    def load(self, address: str, *, older: int = False) -> Saved:
        return super().load(address, older=99 if older else 0)


class OneBackAtMost(OneFile):
    """Goes back one snapshot at most."""

    def load(self, address: str, *, older: int = False) -> Saved:
        return super().load(address, older=bool(older))


class OlderWithTooFew(OneFile):
    """Gives an older snapshot with the entries that belong to the newest."""

    def load(self, address: str, *, older: int = False) -> Saved:
        return super().load(address, older=older)._replace(entries=super().load(address).entries)


class HighestTurnFirst(MoreThanACut):
    """Takes the snapshot of the highest turn for the newest."""

    def spoil(self, contents: Contents, address: str, drop: Drop) -> None:
        contents.snapshots[address].sort(key=lambda one: one[1])


class LosesTheTurn(OneFile):
    """Has the turn of a snapshot in memory alone."""

    def _read(self) -> Contents:
        contents = super()._read()
        for address, kept in contents.snapshots.items():
            contents.snapshots[address] = [(data, 0, contained) for data, _, contained in kept]
        return contents


class ShortTurns(OneFile):
    """Stores turns in 32 bits."""

    def cut(self, address: str, snapshot: bytes, drop: Drop, *, turn: int, keep: int = 2) -> None:
        super().cut(address, snapshot, drop, turn=turn % 2**32, keep=keep)


class EmptyIsNoSnapshot(OneFile):
    """Gives an empty snapshot back as none."""

    def load(self, address: str, *, older: int = False) -> Saved:
        saved = super().load(address, older=older)
        return saved._replace(snapshot=saved.snapshot or None)


class OneMebibyte(OneFile):
    """Cuts large snapshots off."""

    def cut(self, address: str, snapshot: bytes, drop: Drop, *, turn: int, keep: int = 2) -> None:
        super().cut(address, snapshot[: 1 << 20], drop, turn=turn, keep=keep)


class SameBytesOnce(OneFile):
    """Takes a snapshot of the same bytes as the one before for that one."""

    def cut(self, address: str, snapshot: bytes, drop: Drop, *, turn: int, keep: int = 2) -> None:
        if super().load(address).snapshot != snapshot:
            super().cut(address, snapshot, drop, turn=turn, keep=keep)


class ForgetsNotesAtACut(MoreThanACut):
    """Forgets all notes with a cut."""

    def spoil(self, contents: Contents, address: str, drop: Drop) -> None:
        contents.notes.clear()


class ForgetsPacksAtACut(MoreThanACut):
    """Forgets the blocks of all other addresses with a cut."""

    def spoil(self, contents: Contents, address: str, drop: Drop) -> None:
        contents.blocks = {key: pack for key, pack in contents.blocks.items() if key[0] == address}
