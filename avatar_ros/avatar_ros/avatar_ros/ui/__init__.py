"""Parts of the planning page in the browser.

Panels, the view of the organ, the driver of its tools, recordings, and requests to the other nodes.
The contact loop never waits for any of them.
"""
