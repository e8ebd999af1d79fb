"""Measuring a whole cell of real processes: a scripted tool at 1 kHz, a viewer of the clouds, and
what periods, latencies, memory, files and threads came to.
"""
