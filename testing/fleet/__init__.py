"""Programs on several machines, simulated on the virtual clock."""
