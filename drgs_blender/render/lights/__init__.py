"""Lights: the environment, Blender's lights and mesh lights, their importance sampling and pdfs."""
