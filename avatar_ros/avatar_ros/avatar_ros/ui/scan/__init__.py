"""Files of the library for the planning page, and images in three planes beside the organ."""
