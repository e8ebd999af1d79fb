"""Read surfaces and label maps, and mesh them.

The input is a surface or a label map in any unit. The output is a checked surface, its signed
distance (level set) and a tetrahedral mesh with clamped and accessible regions [m, RAS].
"""
