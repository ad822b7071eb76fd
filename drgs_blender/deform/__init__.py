"""Surfels follow a mesh: binding (Algorithm 1) and the mesh-driven update."""
