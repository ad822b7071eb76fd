import bpy

settings = bpy.context.scene.drgs

settings.samples = 1024
settings.use_strategy_samples = False
settings.bounces = 4
settings.use_noise_threshold = True
settings.noise_threshold = 0.01
settings.clamp_indirect = 0.0
settings.filter_glossy = 0.0
settings.subpixel_samples = 0
settings.denoise = "svgf"
