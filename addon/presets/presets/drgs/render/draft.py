import bpy

settings = bpy.context.scene.drgs

settings.samples = 16
settings.use_strategy_samples = False
settings.bounces = 1
settings.use_noise_threshold = False
settings.noise_threshold = 0.01
settings.clamp_indirect = 10.0
settings.filter_glossy = 1.0
settings.subpixel_samples = 0
settings.denoise = "svgf"
