import bpy

settings = bpy.context.scene.drgs

settings.rays = 64
settings.use_custom_split = False
settings.bounces = 2
settings.use_noise_threshold = False
settings.noise_threshold = 0.01
settings.clamp_indirect = 10.0
settings.aa = 0
settings.denoise = "svgf"
