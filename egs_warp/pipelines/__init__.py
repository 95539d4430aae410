"""Whole ways on one page: scene to object, object to creature, creature to film.

In: a capture and what is asked of it. Out: files, and records of what was found, planned and reached.
"""
