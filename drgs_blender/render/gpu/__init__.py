"""The renderer's kernels on a graphics card, by Warp; on its CPU device for tests."""
