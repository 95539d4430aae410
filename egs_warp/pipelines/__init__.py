"""End-to-end pipelines: scene to object, object to creature, creature to film (section 3 of the paper).

Input: a capture and options. Output: files, and records of the measured, planned and reached values.
"""
