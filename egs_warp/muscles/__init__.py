"""Fibres that pull inside a cage (section 3.2, Eq. 7).

In: a cage and its up, or a user's file. Out: muscles: where they are attached, how strong they are, and what they pull.
"""
