"""Light at the visible points: BRDF, sampling, paths."""
