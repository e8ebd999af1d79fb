"""A new patient on the planning page: labels, a preview of the clamp, and the build."""
