"""Compiled kernels on plain floats and arrays: numpy, numba and math only."""
