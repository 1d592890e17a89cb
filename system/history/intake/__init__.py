"""How much of what happens the history takes in."""
