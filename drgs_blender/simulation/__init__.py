"""The physics solvers: MLS-MPM particles (P2G, G2P, constitutive models), XPBD, rigid bodies, colliders, force fields.

An asset and settings become a particle cache. Blender's side (panel, bake, playback) is `addon/physics`; the materials
are rows of `core.sim_materials`.
"""
