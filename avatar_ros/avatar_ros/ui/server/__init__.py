"""Serves the planning page: who may use it, how fast messages go to a browser, and its index."""
