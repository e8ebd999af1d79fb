"""Tips in tissue: the law of their contact, for their shape and that of the surface, and the dent
that they show.

Nothing here knows an organ but by its distance, its modulus and its compliance for a patch.
"""
