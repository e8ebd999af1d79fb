"""Known anatomies and a new patient among them. Surfaces come in, an atlas that grows one by one
goes out; with a patient's surface, a vademecum at one of three fidelities: interpolated (paper,
Eq. 18), reduced by Galerkin projection, or solved.
"""
