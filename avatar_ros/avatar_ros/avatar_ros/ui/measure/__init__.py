"""Measures on the planning page: a probe, a ruler, a plane, and distances around the tool."""
