"""Deformation: surfels are attached to a mesh (binding, Algorithm 1) and follow it; GMLS, fracture, granular."""
