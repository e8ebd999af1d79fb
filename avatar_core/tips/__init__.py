"""What a tip does to tissue: the law of its contact, for its shape and that of the surface, and
the dent that it shows.

Nothing here knows an organ but by its distance, its modulus and its compliance for a patch.
"""
