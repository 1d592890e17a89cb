"""Help for testing actors."""
