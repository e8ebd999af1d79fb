"""The ``avatar`` command, one file a subcommand.

Arguments come in; text, files and pictures go out. Errors of the core become one line and an exit
code. Nothing is computed here.
"""
