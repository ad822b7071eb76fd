"""Surfels: rasterised on the screen (splats), and traced along rays (surfel BVH)."""
