"""From posed surfels and a light to passes and files."""
