"""Model order reduction. Finite element problems and solutions come in; separated fields u(x, s,
p) = sum_k X_k(x) Y_k(s) Z_k(p) go out: Proper Generalized Decomposition (paper, Sec. 2.1),
principal components region by region, Galerkin projection, asymptotic series in the load, and the
exact near field of the contact compliance.
"""
