"""Finite elements on tetrahedral meshes.

A mesh and a material come in; stiffness, solutions under patch loads and stable equilibria at large
strain go out. The weak forms are linear elasticity (P2 or Taylor-Hood) and St Venant-Kirchhoff and
neo-Hookean solids, by scikit-fem.
"""
