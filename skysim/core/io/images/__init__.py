"""Image files (FITS, PNG, TIFF, JPEG, BMP) and frames of a live camera, read with limits on their size.

A few bytes of a damaged or hostile file can declare an image that exceeds the memory. The declared size is therefore
read from the header, and checked, before astropy (`fits.py`) or OpenCV (`encoded.py`) decodes the file.
"""

from skysim.core.io.images.fits import read_fits as read_fits
from skysim.core.io.images.live import LiveCamera as LiveCamera
from skysim.core.io.images.live import grab_frame as grab_frame
from skysim.core.io.images.reader import IMAGE_SUFFIXES as IMAGE_SUFFIXES
from skysim.core.io.images.reader import Picture as Picture
from skysim.core.io.images.reader import image_suffix as image_suffix
from skysim.core.io.images.reader import is_fits as is_fits
from skysim.core.io.images.reader import monochrome as monochrome
from skysim.core.io.images.reader import read_image as read_image
from skysim.core.io.images.reader import read_picture as read_picture
