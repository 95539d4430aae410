"""End-to-end pipelines: from scene to object, from object to creature, from creature to film (section 3 of the paper).

Input: a capture and options. Output: files, and records of planned and measured values.
"""
