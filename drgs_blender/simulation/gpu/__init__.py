"""The grid of the particle solver on a graphics card."""
