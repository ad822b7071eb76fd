"""Learning on a graphics card: torch tensors and Warp kernels."""
