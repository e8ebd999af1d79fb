"""Model order reduction: separated fields u(x, s, p) = sum_k X_k(x) Y_k(s) Z_k(p).

Finite element problems and solutions come in; separated fields go out. The methods are Proper
Generalized Decomposition (paper, Sec. 2.1), principal components region by region, and Galerkin
projection. Asymptotic series in the load and the exact near field of the contact compliance
complete them.
"""
