"""The online stage: contact between tool tips and an organ at 1 kHz.

A vademecum, tool tips and effects come in. ``prepare`` lays them out and may fail. ``step`` gives
forces and displacements at 1 kHz and never fails, allocates or blocks. The equations are those of
unilateral contact, of each effect (:mod:`avatar_core.contact.effects`), and of the safety of a
haptic loop (:mod:`avatar_core.haptics`).
"""
