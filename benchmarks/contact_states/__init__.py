"""Searches over contact states as in the literature, to which ``table2.py`` compares the engine's."""
