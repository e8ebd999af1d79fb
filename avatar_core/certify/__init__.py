"""Errors of a vademecum. A vademecum and the finite element problem it was built from come in;
relative errors on loads and contacts that the build never saw go out.
"""
