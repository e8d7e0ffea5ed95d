"""Still pictures from outside: PNG and JPEG alone, of a bounded size.

Pillow hands other formats to other programs (EPS to Ghostscript), and only warns of a picture that fills the memory.
"""

from __future__ import annotations

import warnings
from io import BytesIO

from PIL import Image

from manip_il.data.schema import MOST_PIXELS

_FORMATS = ("PNG", "JPEG")


def open_picture(content: bytes) -> Image.Image:
    """Open a PNG or JPEG, whose pixels are not decoded yet.

    Raises `ValueError` for another format, and for more than `MOST_PIXELS` pixels.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            picture = Image.open(BytesIO(content), formats=_FORMATS)
    except Image.UnidentifiedImageError as error:
        raise ValueError(f"it is not a {' or '.join(_FORMATS)}") from error
    except (Image.DecompressionBombWarning, Image.DecompressionBombError) as error:
        raise ValueError(f"it has more than {MOST_PIXELS:,} pixels") from error
    if picture.width * picture.height > MOST_PIXELS:
        raise ValueError(f"it has {picture.width} x {picture.height} pixels; expected at most {MOST_PIXELS:,} in all")
    return picture
