"""The renderer: posed surfels and a light to passes and files."""
