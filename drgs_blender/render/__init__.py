"""The renderer: posed surfels and a light to passes and files. `pipeline` runs the stages, one folder each."""
