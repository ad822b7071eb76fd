"""Foreign files in and out, behind one registry."""
