"""Registration of a vademecum to observed points of its organ.

A sparse, partial, noisy cloud of points on the deformed surface comes in. Loads, rigid motion and
the displacement everywhere go out, each with its standard deviation, and whether they explain the
cloud.
"""
