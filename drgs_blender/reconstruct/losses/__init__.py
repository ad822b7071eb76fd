"""Losses of training: photometric (L1, SSIM), and of the shape (normals, distortion, masks)."""
