"""Searches over contact states from the literature; ``table2.py`` compares them with the engine's search."""
