"""The exhaustive search: which steps of a run have to do with each other, and so which orders have to be tried."""
