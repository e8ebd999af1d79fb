"""What is to be simulated, and what was. YAML comes in, a checked scene goes out: organ, tools,
outputs and effects. Recordings of a tool are kept and replayed, vademecums exported for ParaView.
"""
