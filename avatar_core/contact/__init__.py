"""The online stage. A vademecum, tool tips and effects come in; ``prepare`` lays them out and may
fail, ``step`` gives forces and displacements at 1 kHz and never fails, allocates or blocks.
Equations of unilateral contact, of each effect (:mod:`avatar_core.contact.effects`) and of what
stands between a force and a hand (:mod:`avatar_core.contact.haptics`).
"""
