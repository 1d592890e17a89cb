"""Stores judged by a model: what a journal promises, drawn operations, kills, failures and two owners."""
