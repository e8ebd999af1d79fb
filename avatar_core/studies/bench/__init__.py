"""Does this machine hold 1 kHz? Vademecums and scenes come in; times of a step go out, beside a
dense table, a direct solve and a step fused by hand, in the same run.
"""
