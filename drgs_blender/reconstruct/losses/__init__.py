"""Losses of pre-training: photographs, shape."""
