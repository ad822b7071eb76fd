"""The surfels that are learned, and the differentiable rasteriser that shows them."""
