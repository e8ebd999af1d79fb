"""Scenes and recordings. YAML comes in; a checked scene goes out: organ, tools, outputs and
effects. Recordings of a tool are stored and replayed, vademecums exported for ParaView.
"""
