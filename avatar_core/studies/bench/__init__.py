"""Benchmarks of the step. Vademecums and scenes come in; step times go out, beside a dense table, a
direct solve and a hand-written linear step in the same run.
"""
