"""Measures a whole cell of real processes with a scripted tool at 1 kHz and a viewer of clouds:
periods, latencies, memory, files and threads.
"""
