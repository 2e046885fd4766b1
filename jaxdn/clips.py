"""Clips on disk: folders of multi-layer OpenEXR frames plus one ``clip.json``, and the training data made from them.

Reading and writing needs OpenEXR alone; ``training_batches`` loads Grain on first use.
"""

import importlib
from typing import TYPE_CHECKING, Any

from jaxdn.data.clip.folder import begin_record as begin_record
from jaxdn.data.clip.folder import begun_record as begun_record
from jaxdn.data.clip.folder import find_clips as find_clips
from jaxdn.data.clip.folder import finish_record as finish_record
from jaxdn.data.clip.folder import frame_path as frame_path
from jaxdn.data.clip.folder import is_clip as is_clip
from jaxdn.data.clip.folder import read_frames as read_frames
from jaxdn.data.clip.folder import read_record as read_record
from jaxdn.data.clip.folder import write_clip as write_clip
from jaxdn.data.clip.frames import StoredFrame as StoredFrame
from jaxdn.data.clip.frames import read_frame as read_frame
from jaxdn.data.clip.frames import write_frame as write_frame
from jaxdn.data.errors import ClipError as ClipError
from jaxdn.data.exr.exr import read_exr as read_exr
from jaxdn.data.exr.exr import write_exr as write_exr
from jaxdn.data.exr.exr import write_image as write_image
from jaxdn.data.foreign.import_exr import plain_frames as plain_frames
from jaxdn.data.foreign.layers import detect_channels as detect_channels
from jaxdn.data.foreign.vectors import MOTION_CONVENTIONS as MOTION_CONVENTIONS
from jaxdn.data.read import open_frames as open_frames
from jaxdn.data.read import read_clip as read_clip

if TYPE_CHECKING:
    from jaxdn.data.training.dataset import training_batches as training_batches


def __getattr__(name: str) -> Any:
    if name == "training_batches":
        return importlib.import_module("jaxdn.data.training.dataset").training_batches
    raise AttributeError(f"module 'jaxdn.clips' has no attribute {name!r}")
