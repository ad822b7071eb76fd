"""Assets made from foreign files: make, import, material transfer, proxy meshes; and export to other programs."""
