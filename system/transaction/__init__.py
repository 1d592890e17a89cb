"""Transactions: several changes of the running tree, checked beforehand and carried out as one step."""
