"""3D Gaussian splats as a field: the picture that a rasteriser draws of a trained file, uncut.

The measurement is the rasterised model (EWA), because that is what the files were trained for; ray tracing
the same Gaussians shows another picture. Rasterisers leave out opacities below 1/255 and what lies beyond
3 σ: invisible, but the picture jumps there, and a derivative that does not know of the jumps is too small.
Here nothing is left out that shows in float32.

Reference: Kerbl et al. 2023, 3D Gaussian Splatting for Real-Time Radiance Field Rendering.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike

from .. import se3
from ..camera import Camera
from ..datasets.splats import Splats, load_splats
from ..errors import FieldError
from ..render.arrays import download, upload, widened
from ..render.backend import use_mitsuba
from .field import ORDERS, Floats, Pixels, Shown, Viewpoint
from .splat_blending import Drawing, blended
from .splat_projection import DILATION, TILE, Cloud, Lens
from .splat_tiles import Places, Tiled, tiled

if TYPE_CHECKING:
    import mitsuba as mi

NEAR = 0.2
"""Centres up to this depth are left out, as INRIA's rasteriser does [unit of the field]."""
_NOTHING = 1.0 / 255.0
"""Where less is covered, nothing is seen that has a depth."""


@dataclass(frozen=True, eq=False)
class Lanes:
    """Pixels on their way into a kernel."""

    drawing: Drawing
    pixel: Pixels
    """(lanes,) which of the pixels each is; a lone one is there twice."""
    first: Places
    last: Places
    """(lanes,) where each one's splats begin and end in `Drawing.members`."""
    film: Floats
    """(lanes, 2) from the principal point [pixel]."""

    def arrays(self) -> tuple[mi.UInt32, mi.UInt32, mi.Vector2f]:
        """First, last and film as kernel input."""
        import mitsuba as mi

        film = mi.Vector2f(*(upload(mi.Float, column) for column in self.film.T))
        return upload(mi.UInt32, self.first), upload(mi.UInt32, self.last), film


class Gaussians:
    """Splats as a `Field`."""

    def __init__(
        self,
        splats: Splats,
        *,
        variant: str = "classic",
        background: ArrayLike = 0.0,
        near: float = NEAR,
        label: str = "splats",
        viewpoints: Sequence[Viewpoint] = (),
        sorted_from: ArrayLike | None = None,
    ) -> None:
        """Splats before a background.

        Args:
            variant: what they were trained with: `classic` (INRIA, gsplat), `antialiased` (gsplat's and
                nerfstudio's mode of that name), `mip` (Mip-Splatting).
            background: grey, or red, green and blue [display-referred].
            near: depth up to which a splat is left out [unit of the splats].
            label: what messages call them.
            viewpoints: cameras that they come with.
            sorted_from: (4, 4) pose whose order of depth every image has, so that none jumps where two splats
                change places; default: its own, as rasterisers sort.

        Raises:
            FieldError: the variant is unknown, the background no colour, or `near` not positive.
            PoseError: `sorted_from` is no rigid motion.
            LLVMError, VariantError: as `use_mitsuba`.
        """
        if variant not in DILATION:
            raise FieldError(f"splats are of the variant {', '.join(DILATION)}, not {variant!r}")
        try:
            colour = np.broadcast_to(np.asarray(background, dtype=np.float64), 3)
        except (TypeError, ValueError):
            colour = np.full(3, np.nan)
        if not np.isfinite(colour).all():
            raise FieldError(f"the background is one number or three, not {background!r}")
        if not (np.isfinite(near) and near > 0.0):
            raise FieldError(f"splats are left out up to a positive depth, not {near!r}")
        use_mitsuba()
        self.splats, self.variant, self.background, self.near = splats, variant, colour, float(near)
        self._label, self._viewpoints = label, tuple(viewpoints)
        self._sorted_from = None if sorted_from is None else se3.as_pose(sorted_from)
        self._cloud = Cloud.of(splats)
        self._tiled: tuple[bytes, Tiled] | None = None

    @property
    def label(self) -> str:
        """Its file, or what kind of object it came from."""
        return self._label

    @property
    def viewpoints(self) -> tuple[Viewpoint, ...]:
        """Cameras that it comes with."""
        return self._viewpoints

    def refuse(self, camera: Camera) -> None:
        """Whether a camera can see it.

        Raises:
            FieldError: its lens distorts or has an aperture; a rasteriser draws a pinhole's picture.
        """
        if camera.distortion is not None:
            raise FieldError(
                f"{self.label}: splats are drawn for a pinhole, and the lens distorts: undistort the "
                "photographs, and give the pinhole's intrinsics"
            )
        if camera.radius > 0.0:
            raise FieldError(f"{self.label}: splats are drawn for a pinhole; take the aperture out")

    def show(
        self,
        camera: Camera,
        pose: Floats,
        pixels: Pixels,
        *,
        order: int = 0,
        kept: Floats | None = None,
    ) -> Shown:
        """The image at the centres of some pixels; arguments as of `Field.show`."""
        values, _ = self._drawn(camera, pose, pixels, order=order, kept=kept, columns=False)
        covered = 1.0 - values[:, 4]
        with np.errstate(invalid="ignore", divide="ignore"):
            depth = np.where(covered < _NOTHING, np.nan, values[:, 3] / covered)
        return Shown(values[:, :3], depth, covered)

    def columns(
        self, camera: Camera, pose: Floats, pixels: Pixels, *, order: int = 0
    ) -> tuple[Floats, Floats]:
        """Values (n, 3) and dI/dξ (n, 3, 6) in the camera's frame; arguments as of `Field.columns`."""
        values, slopes = self._drawn(camera, pose, pixels, order=order, kept=None, columns=True)
        return values[:, :3], slopes

    def provenance(self) -> Mapping[str, Any]:
        """What else the image depends on."""
        return {
            "kind": "3D Gaussian splats, rasterised without cuts",
            "splats": len(self.splats),
            "degree": self.splats.degree,
            "variant": self.variant,
            "background": self.background.tolist(),
            "near": self.near,
            **({} if self._sorted_from is None else {"sorted from": self._sorted_from.tolist()}),
            "fingerprint": self._fingerprint(),
        }

    def _fingerprint(self) -> str:
        told = hashlib.sha256()
        for name in ("means", "rotations", "scales", "opacities", "coefficients"):
            told.update(np.ascontiguousarray(getattr(self.splats, name)).data)
        return told.hexdigest()[:16]

    def _drawn(
        self,
        camera: Camera,
        pose: Floats,
        pixels: Pixels,
        *,
        order: int,
        kept: Floats | None,
        columns: bool,
    ) -> tuple[Floats, Floats]:
        """Colour, Σ T α z and T of pixels (n, 5), and slopes (n, 3, 6 or 0)."""
        if order not in range(ORDERS):
            raise FieldError(f"the order of summation is 0 or 1, not {order!r}")
        n = len(pixels)
        if n == 0:
            return np.empty((0, 5)), np.empty((0, 3, 6 if columns else 0))
        lanes = self.lanes(camera, pose, pixels, kept)
        colour, depth, clear, slopes = blended(lanes.drawing, *lanes.arrays(), order, columns)
        dr.eval(colour, depth, clear, slopes)
        values = np.empty((n, 5))
        values[lanes.pixel] = download([*colour, depth, clear]).T
        found = np.empty((n, 3, len(slopes)))
        for j, slope in enumerate(slopes):
            found[lanes.pixel, :, j] = download(slope).T
        return values, found

    def lanes(self, camera: Camera, pose: Floats, pixels: Pixels, kept: Floats | None = None) -> Lanes:
        """Pixels (n > 0) as a kernel's lanes, which see the splats of their tiles; arguments as of `show`."""
        import mitsuba as mi

        self.refuse(camera)
        pixels = np.asarray(pixels, dtype=np.int64)
        seen = self._seen(camera, np.asarray(pose, dtype=np.float64), kept)
        tile = pixels[:, 1] // TILE * -(-camera.size[0] // TILE) + pixels[:, 0] // TILE
        # Lanes of one tile stand together: they read the same splats.
        pixel = widened(np.argsort(tile.astype(np.uint32), kind="stable"))
        background = mi.Color3f(*(dr.opaque(mi.Float, float(x)) for x in self.background))
        return Lanes(
            Drawing(seen.records, seen.members, Lens.of(camera), self.variant, background),
            pixel,
            seen.first[tile[pixel]],
            seen.first[tile[pixel] + 1],
            (pixels + 0.5 - camera.centre)[pixel],
        )

    def _seen(self, camera: Camera, pose: Floats, kept: Floats | None) -> Tiled:
        """Splats by tile; those of the last pose are at hand, for tile after tile of one image."""
        if kept is None:
            kept = pose if self._sorted_from is None else self._sorted_from
        kept = np.asarray(kept, dtype=np.float64)
        what = (camera.scale, camera.offset, np.asarray(camera.size), pose, kept)
        key = b"".join(np.ascontiguousarray(array).tobytes() for array in what)
        if self._tiled is None or self._tiled[0] != key:
            self._tiled = None
            self._tiled = key, tiled(self._cloud, camera, pose, kept, variant=self.variant, near=self.near)
        return self._tiled[1]


def load_gaussians(
    path: str | Path,
    *,
    variant: str = "classic",
    background: ArrayLike = 0.0,
    near: float = NEAR,
    viewpoints: Sequence[Viewpoint] = (),
) -> Gaussians:
    """A file of splats as a field; arguments as of `Gaussians`.

    Raises:
        FieldError: as `load_splats`, or as `Gaussians`.
    """
    return Gaussians(
        load_splats(path),
        variant=variant,
        background=background,
        near=near,
        label=str(path),
        viewpoints=viewpoints,
    )
