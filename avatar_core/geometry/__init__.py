"""From a file to a mesh. A surface or a label map comes in [any unit]; a checked surface, its
signed distance (level set) and a tetrahedral mesh with clamped and accessible regions go out [m,
RAS].
"""
