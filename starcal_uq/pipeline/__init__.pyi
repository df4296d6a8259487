from .refine import ImageCalibration as ImageCalibration
from .refine import identify_and_calibrate as identify_and_calibrate
