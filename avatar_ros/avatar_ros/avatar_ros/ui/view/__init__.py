"""Draws organ, structures, tools and their forces for the planning page, with scale and letters."""
