"""Trees as files: what is wanted, and the smallest change from what runs to that."""
