from .partitions import PartitionedObservations as PartitionedObservations
from .partitions import open_partitions as open_partitions
from .splits import split_frames as split_frames
from .streams import stream_frames as stream_frames
