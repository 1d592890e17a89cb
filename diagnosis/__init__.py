"""Diagnosis and repair will live here: observers, the model, the engine and the repair planner."""
