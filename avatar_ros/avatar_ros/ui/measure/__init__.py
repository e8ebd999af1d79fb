"""Measures on the planning page: a probe, a ruler, a plane, and what is around the tool."""
