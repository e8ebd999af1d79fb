"""The offline stage. An organ's surface comes in, a certified vademecum goes out: mesh,
solutions, separation by global and regional modes, and the errors against full finite elements
on unseen loads (:mod:`avatar_core.offline.certify`).
"""
