"""Bags of ROS 2, without ROS. MCAP or sqlite3 of a tool's poses and wrenches come in; a recording
goes out, which is replayed as those of the planning page are. Recordings are written as MCAP.
"""
