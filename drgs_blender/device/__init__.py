"""Kernels on another processor than this one: the scalar code of Numba kernels, translated and run by NVIDIA Warp."""
