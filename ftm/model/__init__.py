"""The change model: what mechanisms tolerate, need and cost, and which of them may be composed."""
