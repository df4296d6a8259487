from .centroids import Centroids as Centroids
from .extract import extract_centroids as extract_centroids
from .image import Image as Image
from .read import read_image as read_image
from .read import read_images as read_images
