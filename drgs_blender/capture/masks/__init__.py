"""Masks of the object in photographs with known cameras: found without learning, checked against each other."""
