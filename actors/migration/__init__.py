"""Migration: the same life goes on at another place."""
