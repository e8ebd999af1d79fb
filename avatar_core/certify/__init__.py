"""Errors of a vademecum, relative, on loads and contacts that the build never saw.

A vademecum and the finite element problem it was built from come in; errors go out.
"""
