"""Small image files of every kind, made by Pillow or by hand."""

import io
import struct
import zlib

import numpy as np
from PIL import Image


def picture(height=37, width=51, channels=3):
    """A smooth picture with different corners, so that no orientation looks like another."""
    y, x = np.mgrid[:height, :width].astype(np.float64)
    planes = [200 * x / width + 40, 180 * y / height + 30, 120 + 90 * np.sin(x / 7 + y / 11), 255 * (x + y) / (width + height)]
    return np.stack(planes[:channels], -1).round().astype(np.uint8)


def encode(image, kind="JPEG", mode=None, **options):
    """An array, or a Pillow image, to the bytes of a file."""
    pillow = image if isinstance(image, Image.Image) else Image.fromarray(image)
    stream = io.BytesIO()
    (pillow if mode is None else pillow.convert(mode)).save(stream, kind, **options)
    return stream.getvalue()


def over_white(data):
    """What Pillow makes of a file: EXIF applied, over white, uint8 [H, W, 3]."""
    from PIL import ImageOps

    with Image.open(io.BytesIO(data)) as image:
        image = ImageOps.exif_transpose(image).convert("RGBA")
    white = Image.new("RGBA", image.size, "white")
    return np.asarray(Image.alpha_composite(white, image).convert("RGB"))


def exif(orientation):
    tags = Image.Exif()
    tags[0x0112] = orientation
    return tags.tobytes()


def png_chunk(kind, body):
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(rows, width, bits, color_type, *chunks):
    """A PNG of raw rows (bytes each), with further chunks before its pixels."""
    header = struct.pack(">IIBBBBB", width, len(rows), bits, color_type, 0, 0, 0)
    pixels = zlib.compress(b"".join(b"\0" + row for row in rows))
    parts = [png_chunk(b"IHDR", header), *chunks, png_chunk(b"IDAT", pixels), png_chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)
