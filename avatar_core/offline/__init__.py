"""The offline stage. A mesh, its elastic problem and the patches of its load surface come in, a
vademecum goes out: solutions, separation by global and regional modes, over ranges of materials
and large pushes too. It needs no step, and measures no error of its own
(:mod:`avatar_core.certify`).
"""
