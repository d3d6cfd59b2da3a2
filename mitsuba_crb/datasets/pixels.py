"""Images of textures as arrays."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SceneError


def decoded(data: bytes, name: str) -> NDArray[np.uint8]:
    """An image file's pixels (H, W, 3), or (H, W, 4) if it has an alpha channel.

    Raises:
        SceneError: it is no image, or damaged; it says `name`.
    """
    from PIL import Image

    try:
        return pixels_of(Image.open(io.BytesIO(data)))
    except Exception as error:  # what decoders stumble over in damaged data has no common class
        raise SceneError(
            f"{name} is no image that can be read ({str(error)[:80]}); export it again"
        ) from error


def pixels_of(picture: Any) -> NDArray[np.uint8]:
    """The pixels of PIL's image."""
    has_alpha = picture.mode in ("RGBA", "LA", "PA") or "transparency" in picture.info
    return np.asarray(picture.convert("RGBA" if has_alpha else "RGB"))
