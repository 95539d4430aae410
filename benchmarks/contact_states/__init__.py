"""Searches over contact states from the literature, with which ``table2.py`` compares the engine's."""
