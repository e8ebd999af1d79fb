"""The parts of the planning page in the browser: panels, the view of the organ, the driver of its
tool, recordings, and requests to the other nodes. The contact loop never waits for any of them.
"""
