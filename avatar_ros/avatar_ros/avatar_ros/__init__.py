"""ROS 2 nodes that wrap :mod:`avatar_core`.

Poses of tools and requests come in as messages; wrenches, deformation, state and diagnostics go
out. The rooms, in the order in which they import: framework, loop, prepare, patients, ui, nodes,
bench.
"""
