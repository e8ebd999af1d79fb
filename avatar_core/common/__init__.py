"""Tools that every room needs: checked files, HDF5, numbers with units, splines, compilation.

Plain values come in and go out. The only equations here are those of uniform quadratic B-splines.
"""
