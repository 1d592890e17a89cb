"""Fault-tolerance mechanisms that are attached, exchanged and composed while requests flow will live here."""
