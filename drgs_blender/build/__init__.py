"""From foreign files to a whole asset: make, import, material transfer, proxy meshes; and out to other programs."""
