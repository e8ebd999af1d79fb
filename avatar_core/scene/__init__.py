"""Scenes and recordings: YAML comes in, a checked scene goes out.

A scene has an organ, tools, outputs and effects. Recordings of a tool are stored and replayed,
vademecums exported for ParaView.
"""
