"""The computational vademecum itself. Separated fields come in; displacement and contact
compliance at any place, load and material go out, with the certificate of their errors, the
accuracy curve, and the HDF5 file that holds all of it: u(x, s) = global modes + those of the region
of s.
"""
