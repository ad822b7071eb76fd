"""The surfels that are learned: parameters, initialisation, and the differentiable rasteriser (2DGS)."""
