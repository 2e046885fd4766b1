"""Clips on disk: folders of multi-layer OpenEXR frames plus one ``clip.json``, and the training data made from them.

Reading and writing needs OpenEXR alone; ``training_batches`` loads Grain on first use.
"""

import importlib
from typing import Any

from jaxdn.clips.exr import read_exr as read_exr
from jaxdn.clips.exr import write_exr as write_exr
from jaxdn.clips.exr import write_image as write_image
from jaxdn.clips.files import ClipError as ClipError
from jaxdn.clips.folder import begin_record as begin_record
from jaxdn.clips.folder import begun_record as begun_record
from jaxdn.clips.folder import find_clips as find_clips
from jaxdn.clips.folder import finish_record as finish_record
from jaxdn.clips.folder import frame_path as frame_path
from jaxdn.clips.folder import is_clip as is_clip
from jaxdn.clips.folder import open_frames as open_frames
from jaxdn.clips.folder import read_clip as read_clip
from jaxdn.clips.folder import read_frames as read_frames
from jaxdn.clips.folder import read_record as read_record
from jaxdn.clips.folder import write_clip as write_clip
from jaxdn.clips.frames import StoredFrame as StoredFrame
from jaxdn.clips.frames import read_frame as read_frame
from jaxdn.clips.frames import write_frame as write_frame
from jaxdn.clips.import_exr import plain_frames as plain_frames
from jaxdn.clips.layers import detect_channels as detect_channels
from jaxdn.clips.vectors import MOTION_CONVENTIONS as MOTION_CONVENTIONS


def __getattr__(name: str) -> Any:
    if name == "training_batches":
        return importlib.import_module("jaxdn.clips.dataset").training_batches
    raise AttributeError(f"module 'jaxdn.clips' has no attribute {name!r}")
