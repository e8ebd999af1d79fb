"""What every room needs and none owns: files and HDF5 with checks, numbers with units, splines,
the compiler settings of the 1 kHz step. Plain values come in and go out; the only equations here
are those of uniform quadratic B-splines.
"""
