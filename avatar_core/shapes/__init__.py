"""Comparison of anatomies: elastic registration and weights of neighbours.

Surfaces and level sets come in. A template registered to each of them, the correspondence that
follows, and weights of neighbours go out. Weights come from locally linear embedding (paper, Eq. 15
and 16) and barycentric coordinates.
"""
