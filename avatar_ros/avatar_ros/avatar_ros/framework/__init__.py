"""Functions that all nodes share.

Managed life cycle, declared parameters, quality of service, message templates and conversions,
real-time priority, saved state, and confined reading of files.
"""
