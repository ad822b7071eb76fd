"""Learning on a device: torch's tensors there, and kernels of Warp where tensor operations would be slow."""
