"""The 1 kHz loop of the contact node.

Poses come in, one compiled step runs, and wrench, state and cloud go out.

A method marked *real-time safe* is meant for the loop. It takes no lock, reads no file, writes no
log and raises nothing in ordinary use. It allocates only the small objects of a Python call.
All other methods belong to the node's threads.
"""
