import bpy

settings = bpy.context.scene.drgs

settings.rays = 1024
settings.use_custom_split = False
settings.bounces = 4
settings.use_noise_threshold = True
settings.noise_threshold = 0.01
settings.clamp_indirect = 0.0
settings.aa = 0
settings.denoise = "svgf"
