"""Motions of a body: jump, hop, twist, walk, crawl, roll, dance, get up, key frames and scripts (section 4).

A motion is a state machine. Each time step it turns the measured state of the body into the objectives of the step.
"""
