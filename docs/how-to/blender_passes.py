"""Set up a Blender file for jaxdn: few samples, no denoiser, and the passes that a temporal denoiser reads.

blender -b shot.blend -P blender_passes.py -o //noisy/ -a
"""

import bpy

scene = bpy.context.scene
scene.render.engine = "CYCLES"
scene.render.use_motion_blur = False  # with it Blender writes no motion vectors
scene.render.use_compositing = False  # the file has to hold the renderer's own passes
scene.render.use_sequencer = False
scene.cycles.samples = 4
scene.cycles.use_adaptive_sampling = False
scene.cycles.use_denoising = False
scene.cycles.use_animated_seed = True  # new noise in every frame: the same noise would look like texture
scene.cycles.pixel_filter_type = "BOX"  # wider filters spread a bright sample over several pixels
scene.cycles.filter_width = 1.0

for layer in scene.view_layers:
    layer.use_pass_z = True
    layer.use_pass_vector = True
    layer.use_pass_object_index = True
    layer.cycles.denoising_store_passes = True  # albedo, normal, depth, and the noisy image

settings = scene.render.image_settings
if hasattr(settings, "media_type"):  # since Blender 5.0
    settings.media_type = "MULTI_LAYER_IMAGE"
settings.file_format = "OPEN_EXR_MULTILAYER"
settings.color_depth = "32"
