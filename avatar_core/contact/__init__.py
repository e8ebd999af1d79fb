"""The online stage. A vademecum, tool tips and effects come in; ``prepare`` lays them out and may
fail, ``step`` gives forces and displacements at 1 kHz and never fails, allocates or blocks.
Equations of unilateral contact, of each effect (:mod:`avatar_core.contact.effects`), and of the
safety of a haptic loop (:mod:`avatar_core.haptics`).
"""
