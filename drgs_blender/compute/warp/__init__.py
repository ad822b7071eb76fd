"""Scalar code of Numba kernels translated for NVIDIA Warp, and its launch."""
