"""Experiments: those of the paper and ours, each with its rivals in the same run. Folders of livers
come in; tables, JSON and pictures go out. Only the command imports this package.
"""
