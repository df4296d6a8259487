from .splits import split_frames as split_frames
from .streams import stream_frames as stream_frames
