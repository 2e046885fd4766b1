"""Clips on disk: folders of multi-layer OpenEXR frames plus one ``clip.json``, and the training data made from them."""

from jaxdn.clips.exr import read_exr as read_exr
from jaxdn.clips.exr import write_exr as write_exr
from jaxdn.clips.exr import write_image as write_image
from jaxdn.clips.files import ClipError as ClipError
from jaxdn.clips.frames import read_frame as read_frame
from jaxdn.clips.frames import write_frame as write_frame
