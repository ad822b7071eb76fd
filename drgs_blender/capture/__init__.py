"""Photographs or a video without cameras to a capture that `reconstruct` reads: structure from motion, markers."""
