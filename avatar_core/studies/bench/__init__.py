"""Benchmarks of the step, beside a dense table and a direct solve in the same run.

Vademecums and scenes come in; step times go out.
"""
