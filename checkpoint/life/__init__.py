"""The life of a recorded actor: its inbox, its context, and what watches over its handlers."""
