"""The tabs of the planning page, each with its controls; what they do is in ``Actions``."""
