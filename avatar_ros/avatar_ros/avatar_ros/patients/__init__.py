"""Building a patient's vademecum next to a node that keeps answering.

A supervised process holds the atlas, reports progress and can be cancelled. A file is written as a
whole or not at all.
"""
