"""Surfels on the screen and along rays."""
