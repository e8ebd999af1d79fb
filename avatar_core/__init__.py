"""Patient avatars: an organ becomes a vademecum that answers a haptic tool at 1 kHz.

The rooms, in the order in which data flows and imports may run: common, geometry, fem, reduction,
shapes, vademecum, contact, scene, offline, atlas; then studies and cli, which use all of them.
"""
