"""Measurements of all of it: the paper's experiments and ours, each with its rivals in the same
run. Nothing but the command imports this room. Folders of livers come in; tables, JSON and
pictures go out.
"""
