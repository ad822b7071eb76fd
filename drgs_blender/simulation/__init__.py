"""Simulated matter: particles that fill a mesh, MLS-MPM, XPBD and rigid bodies that move them, frames on disk."""
