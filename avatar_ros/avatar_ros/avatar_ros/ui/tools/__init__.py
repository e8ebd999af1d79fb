"""The tools of the planning page: their places, the process that drives them, and undo."""
