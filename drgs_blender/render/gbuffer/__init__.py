"""The G-buffer: the camera's primary hits of surfels, meshes and visible lights, and their shading points."""
