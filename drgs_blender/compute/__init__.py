"""Compiled kernels: Numba's configuration, the kernel cache, threads, SIMD, ahead-of-time compilation."""
