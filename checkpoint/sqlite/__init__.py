"""The durable journal: one SQLite file (WAL), large snapshots in files beside it.

Beside `app.db` live SQLite's `-wal` and `-shm`, the directory `app.db-snapshots` and, while the store is open or after
a crash, `app.db-mark`: the last acknowledged position; and what lies in `app.db-log`.

Log        A few entries are one write to a log, and go to the database with whatever is written there next, at the
           latest when they are 512. A new owner seals the log, so that nobody else writes to it unnoticed, and brings
           it into the database before anything else. `append_log.py` says how a power loss is survived.

Exclusion  The `store` row names the owning process (pid and start time) and an epoch that rises at each opening; every
           write checks the epoch inside its transaction. SQLite's locks are held for one short transaction only, so
           a stopped owner keeps nobody out for longer than it takes to kill it.
Integrity  Each row carries a CRC-32 over its place and content, and its number in the chain of its address (1, 2, ...).
           The row of the address has count and sum of the chain numbers removed by cuts. With n rows left and r
           removed, the numbers must be exactly 1..n+r: the sums agree only then, or when rows are missing at the very
           end. Those the `store` row (how many rows there were up to `floor`) and the mark notice.
Layout     Entries are clustered by position and have no index by address: it would cost a third of the speed, more
           when a batch spans many addresses. The positions of each address are held in memory (8 bytes each) instead
           and found again by one scan at the opening.

Read `engine.py` first: it has the journal, as far as it is not about the file. `open_store.py` opens, writes and closes
the file, `append_log.py` is in front of it, `ownership.py` decides who owns it, `entry_chains.py` finds what is in it,
`read_back.py` reads an address back, `position_mark.py` and `snapshot_files.py` keep what is beside it, `row_codec.py`
has the bytes of rows.
"""

from __future__ import annotations

from .engine import SqliteJournal

__all__ = ["SqliteJournal"]
