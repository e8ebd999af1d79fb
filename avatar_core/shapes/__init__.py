"""Comparing anatomies. Surfaces and level sets come in; a template laid on each of them, the
correspondence it carries, and weights of neighbours go out: elastic registration, locally linear
embedding (paper, Eq. 15 and 16), barycentric and kriging weights.
"""
