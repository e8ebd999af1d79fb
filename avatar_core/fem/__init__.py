"""Finite elements on that mesh. A mesh and a material come in; stiffness, solutions under patch
loads and stable equilibria at large strain go out. Weak forms of linear elasticity (P2 or
Taylor-Hood) and of St Venant-Kirchhoff and neo-Hookean solids, by scikit-fem.
"""
