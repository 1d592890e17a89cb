"""Charts of a simulated run: its turns, which of them lead to the failure, and how that is shown."""
