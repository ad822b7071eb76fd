"""Compiled kernels: Numba's configuration, the kernel cache, SIMD."""
