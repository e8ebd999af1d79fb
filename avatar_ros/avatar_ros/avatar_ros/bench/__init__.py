"""Measurements of a whole cell of real processes, with a scripted tool at 1 kHz.

They give periods, latencies, memory, files and threads.
"""
