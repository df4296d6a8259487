from .partitions import PartitionedObservations as PartitionedObservations
from .partitions import open_partitions as open_partitions
from .repeats import Fingerprints as Fingerprints
from .splits import split_frames as split_frames
