"""The particle solver on a graphics card, by the scalar functions that the processor's kernels call."""
