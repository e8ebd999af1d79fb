"""Benchmarks of the step. Vademecums and scenes come in; step times go out, beside a dense table
and a direct solve in the same run.
"""
