"""What entries and snapshots are encoded as in every store, and how they are made smaller."""
