"""What every node shares: managed life cycle, declared parameters, quality of service,
conversions between arrays and messages, real-time priority, kept state, and the confined reading
of files.
"""
