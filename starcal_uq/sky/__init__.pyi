from .apparent import aberrate as aberrate
from .apparent import apparent_directions as apparent_directions
from .apparent import catalogue_directions as catalogue_directions
from .apparent import earth_velocity_km_s as earth_velocity_km_s
from .apparent import make_apparent as make_apparent
from .apparent import without_low_stars as without_low_stars
from .site import Site as Site
from .tables import read_catalogue as read_catalogue
