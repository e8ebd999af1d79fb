"""The offline stage: from a mesh, its elastic problem and its load patches to a vademecum.

It solves, and separates by global and regional modes, also over ranges of materials and for large
pushes. It needs no step, and measures none of its own errors (:mod:`avatar_core.certify`).
"""
