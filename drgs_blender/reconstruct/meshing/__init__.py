"""Meshing: depth maps and masks to a closed mesh."""
