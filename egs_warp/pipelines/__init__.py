"""End-to-end pipelines: scene to object, object to creature, creature to film (section 3 of the paper).

A pipeline takes a capture and options. It writes files and returns records of measured, planned and reached values.
"""
