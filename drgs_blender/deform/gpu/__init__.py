"""Deformation on a graphics card, by Warp; on Warp's CPU device for tests."""
