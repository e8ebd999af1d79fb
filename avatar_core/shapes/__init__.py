"""Comparison of anatomies. Surfaces and level sets come in; a template registered to each of them,
the correspondence that follows, and weights of neighbours go out: elastic registration, locally
linear embedding (paper, Eq. 15 and 16), barycentric weights.
"""
