"""Images as files."""

import io

from PIL import Image


def png_of(image):
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "png")
    return buffer.getvalue()
