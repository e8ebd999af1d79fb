"""The 1 kHz loop of the contact node: poses come in, one compiled step runs, wrench, state and
cloud go out. Nothing in here allocates, blocks, logs or raises once the loop runs.
"""
