"""MLS-MPM on a graphics card, by Warp: the particle grid and its time steps."""
