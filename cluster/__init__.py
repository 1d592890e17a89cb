"""Many machines: a journal that is replicated, and who leads."""
