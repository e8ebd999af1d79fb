"""Known anatomies, and a new patient among them.

Surfaces come in; an atlas goes out that grows one by one. With a patient's surface, it gives a
vademecum at one of three fidelities: interpolated (paper, Eq. 18), reduced by Galerkin projection,
or solved.
"""
