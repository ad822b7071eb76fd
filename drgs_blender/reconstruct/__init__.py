"""Photographs to an asset: readers, training of surfels, meshing (TSDF), inverse rendering."""
