"""Simulated matter: particles that fill a mesh, their motion, frames on disk."""
