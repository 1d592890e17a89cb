"""The judge: which promise of the journal protocol an engine breaks first."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import ModuleType

from holdfast.checkpoint.journal import Journal
from holdfast.testing.store_model.accidents import ACCIDENTS, KILLS
from holdfast.testing.store_model.bench import Bench, Crash, Factory
from holdfast.testing.store_model.contents import BOUNDS, CONTENTS
from holdfast.testing.store_model.sequences import agrees_with_the_model
from tests.checkpoint.one_file import OneFile
from tests.testing.stores import broken_entries, broken_names, broken_snapshots, broken_writes

MODULES: dict[str, ModuleType] = {
    "entries and positions": broken_entries,
    "snapshots": broken_snapshots,
    "notes, blocks, addresses, erasure": broken_names,
    "kills, failures, owners, threads": broken_writes,
}
"""Broken engines, by what they break."""
BASES = (
    OneFile,
    broken_entries.Changing,
    broken_names.RenamingNotes,
    broken_names.RenamingAddresses,
    broken_snapshots.MoreThanACut,
    broken_writes.WritesAtClose,
)
"""What they are derived from, and breaks nothing itself."""
ALWAYS = (
    broken_entries.WritesAppendsLater,
    broken_entries.EntryByEntry,
    broken_entries.PositionsAgain,
    broken_entries.AThousandAtMost,
    broken_entries.TenAddresses,
    broken_names.EraseForgetsNotes,
    broken_names.ErasesBelow,
    broken_names.FoldsCase,
    broken_names.KeysEndAtNul,
    broken_names.ForgetsFiftyPacks,
    broken_snapshots.OlderOnesInMemory,
    broken_snapshots.ForgetsNotesAtACut,
    broken_snapshots.ForgetsPacksAtACut,
    broken_snapshots.IgnoresRanges,
    broken_snapshots.IgnoresSteps,
    broken_writes.EpochAtClose,
    broken_writes.EpochInFourBits,
    broken_writes.NotesAtClose,
    broken_writes.NobodyIsLockedOut,
    broken_writes.RaisesWhatItGets,
    broken_writes.SyncsFilesAlone,
)
"""Those that are judged each time: the others take turns."""
SEEDS = 3


def broken(module: ModuleType) -> list[type[OneFile]]:
    """The broken engines of a module."""
    return [
        one
        for one in vars(module).values()
        if isinstance(one, type) and issubclass(one, OneFile) and one not in BASES and one.__module__ == module.__name__
    ]


def copied(journal: Journal, folder: Path) -> Path:
    """The folder as a kill leaves it."""
    copy = folder.with_name(str(int(folder.name) + 1))
    shutil.copytree(folder, copy)
    return copy


def first_broken_promise(factory: Factory, path: Path, crash: Crash = copied) -> str:
    """The promise that the engine breaks first, and how; nothing if it keeps them all."""
    for promise in (*CONTENTS, *KILLS, *ACCIDENTS, *BOUNDS):
        bench = Bench(factory, crash, path / promise.__name__)
        try:
            promise(bench)
        except Exception as error:
            return f"{promise.__name__}: {error}"
        finally:
            bench.remove()
    for seed in range(SEEDS):
        bench = Bench(factory, crash, path / f"sequence {seed}")
        try:
            agrees_with_the_model(bench, seed, shrinking=0.0)
        except AssertionError as error:
            return f"sequence: {error}"
        finally:
            bench.remove()
    return ""
