"""A vademecum is registered to what is seen of its organ. A sparse, partial, noisy cloud of points
on the deformed surface comes in; loads, rigid motion and the displacement everywhere go out, each
with its standard deviation, and whether they explain the cloud.
"""
