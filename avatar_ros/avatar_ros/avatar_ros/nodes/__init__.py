"""The nodes that ``ros2 run`` starts, one file each, and the planning cell that starts all.

Topics, services and parameters are documented in msg_docs/.
"""
