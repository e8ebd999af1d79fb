"""Errors of a vademecum. A vademecum and the finite element problem it was built from come in;
relative errors on loads that the build never saw go out, and the time that a step takes.
"""
