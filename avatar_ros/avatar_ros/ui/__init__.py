"""The planning page in the browser, part by part: panels, the view of the organ, the driver of
its tool, recordings, and the requests it makes of the other nodes. It only looks on; the loop
never waits for it.
"""
