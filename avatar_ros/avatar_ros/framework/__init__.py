"""What the nodes have in common: managed life cycle, declared parameters, quality of service,
message templates and conversions, real-time priority, saved state, and confined reading of files.
"""
