"""End-to-end pipelines: scene to object, object to creature, creature to film (section 3 of the paper).

In: a capture and options. Out: files, and records of the measured, planned and reached values.
"""
