"""The computational vademecum: u(x, s) = global modes + modes of the region of s.

Separated fields come in. Displacement and contact compliance at any place, load and material go
out. A vademecum carries the certificate of its errors and the accuracy curve; one HDF5 file holds
all of it.
"""
