"""Whether an image file that this package wrote is whole, and what it says about itself."""

from __future__ import annotations

import os
from pathlib import Path

from icheat_usd.errors import ImageError
from icheat_usd.image.exr import METADATA_PREFIX
from icheat_usd.image.png import read_text


def whole_metadata(path: str | os.PathLike[str]) -> dict[str, str]:
    """The metadata of an .exr or .png all of whose pixels can be read.

    Raises
    ------
    ImageError
        The file is missing, of another format, damaged or cut short.
    """
    source = Path(path)
    if source.suffix.lower() == ".png":
        return read_text(source)
    import OpenImageIO as oiio  # 20 MB of libraries

    # Not by the library that writes: it reports damage on stdout and stderr.
    image = oiio.ImageInput.open(str(source))
    if image is None:
        raise ImageError(f"{source}: cannot read the image ({' '.join(oiio.geterror().split())}); write it again")
    try:
        if image.format_name() != "openexr":
            raise ImageError(f"{source}: not an OpenEXR file; convert it to .exr first")
        about = {
            attribute.name.removeprefix(METADATA_PREFIX): attribute.value
            for attribute in image.spec().extra_attribs
            if attribute.name.startswith(METADATA_PREFIX) and isinstance(attribute.value, str)
        }
        part = 0
        while image.seek_subimage(part, 0):
            if image.read_image(part, 0, 0, image.spec().nchannels, oiio.UNKNOWN) is None:
                problem = " ".join(image.geterror().split())
                raise ImageError(f"{source}: the pixels are damaged or cut short ({problem}); write it again")
            part += 1
        # What ends the loop is no error.
        image.geterror()
    finally:
        image.close()
    return about
