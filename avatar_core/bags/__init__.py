"""Bags of ROS 2, without ROS.

A tool's poses and wrenches come in, as MCAP or sqlite3. A recording goes out, which is replayed
like those of the planning page. Recordings are written as MCAP.
"""
