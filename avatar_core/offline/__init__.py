"""The offline stage. An organ's surface comes in, a certified vademecum goes out: mesh,
solutions, separation, choice of the rank, near field, and the errors against full finite elements
on unseen loads (:mod:`avatar_core.offline.certify`).
"""
