"""The last lines of a system: what the processes of its actors print, and what holdfast logs, kept in memory."""
