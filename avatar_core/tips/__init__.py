"""Tips in tissue: their contact law, for the shapes of tip and surface, and the displayed dent.

This room knows an organ only by its distance, its modulus and its compliance for a patch.
"""
