"""Whole ways on one page: scene to object, object to creature, creature to film (all of the paper's section 3).

In: a capture and what is asked of it. Out: files, and records of what was found, planned and reached.
"""
