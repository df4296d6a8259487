from .examples import ExampleData as ExampleData
from .images import observations_from_images as observations_from_images
from .inspection import Frames as Frames
from .inspection import InspectedFrame as InspectedFrame
from .refine import ImageCalibration as ImageCalibration
from .refine import identify_and_calibrate as identify_and_calibrate
