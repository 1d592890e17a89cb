"""The recovery parts as actors: what watches over recoveries, below `/<system>/recovery`."""
