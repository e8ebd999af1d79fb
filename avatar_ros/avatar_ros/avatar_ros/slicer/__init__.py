"""3D Slicer next to the cell, over OpenIGTLink: the connection and the messages."""
