"""Compiled code: Numba set up once, its cache, wide numbers."""
