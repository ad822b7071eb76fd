"""Photographs to an asset: captures, differentiable rasteriser, pre-training, TSDF, decoupling."""
