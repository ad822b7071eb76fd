"""Film, passes and frame files."""
