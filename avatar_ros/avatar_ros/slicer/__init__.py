"""3D Slicer beside the cell, over OpenIGTLink: the connection, and what is sent either way."""
