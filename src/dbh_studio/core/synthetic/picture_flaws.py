"""What the way from the lens to the file does to a rendered picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft, ndimage

from dbh_studio.core.arrays import Float


@dataclass(frozen=True)
class PictureFlaws:
    """What the way from the lens to the file does to a picture.

    Attributes:
        blur_px: Sigma of the lens, in pixels, applied to linear light.
        linear_light: Whether the blur acts before the response curve (a camera) or after it (a resampled picture).
        resampling_px: Sub-pixel shift that is interpolated back, as stitching does.
        sharpening: Share of the unsharp mask.
        noise: Sigma in grey levels of 255.
        jpeg_quality: 1-100; 0 leaves JPEG out.
    """

    blur_px: float = 0.6
    linear_light: bool = True
    resampling_px: tuple[float, float] = (0.3, 0.4)
    sharpening: float = 0.0
    noise: float = 2.0
    jpeg_quality: int = 90


def random_flaws(seed: int) -> PictureFlaws:
    """One camera's flaws, drawn from what consumer 360° cameras do."""
    rng = np.random.default_rng([seed, 2])
    return PictureFlaws(
        blur_px=rng.uniform(0.3, 0.9),
        linear_light=bool(rng.random() < 0.5),
        resampling_px=(rng.uniform(0, 0.5), rng.uniform(0, 0.5)),
        sharpening=float(rng.choice([0.0, 0.3])),
        noise=rng.uniform(1.0, 4.0),
        jpeg_quality=int(rng.integers(80, 96)),
    )


def through_the_camera(light: Float, flaws: PictureFlaws, *, wraps: bool) -> Float:
    """(H, W) light as the grey value of the file: blur, interpolation, response curve and sharpening; 0-1."""
    modes = ("nearest", "wrap" if wraps else "nearest")

    def blur(picture: Float, sigma: float) -> Float:
        return np.asarray(ndimage.gaussian_filter(picture, sigma, mode=modes, truncate=3.0))

    def respond(picture: Float) -> Float:
        return np.asarray(np.clip(picture, 0, 1) ** np.float32(1 / 2.2))

    picture = respond(blur(light, flaws.blur_px)) if flaws.linear_light else blur(respond(light), flaws.blur_px)
    for axis, part in ((1, flaws.resampling_px[0]), (0, flaws.resampling_px[1])):
        # What stands at pixel i was seen at i + part; linear interpolation puts it back.
        before = np.roll(picture, 1, axis)
        if not (wraps and axis == 1):
            edge = (slice(None), slice(0, 1)) if axis == 1 else (slice(0, 1), slice(None))
            before[edge] = picture[edge]
        picture = (1 - part) * picture + part * before
    if flaws.sharpening:
        picture = picture + flaws.sharpening * (picture - blur(picture, 1.0))
    return picture


_JPEG_TABLE = np.array(
    [
        [16, 11, 10, 16, 24, 40, 51, 61],
        [12, 12, 14, 19, 26, 58, 60, 55],
        [14, 13, 16, 24, 40, 57, 69, 56],
        [14, 17, 22, 29, 51, 87, 80, 62],
        [18, 22, 37, 56, 68, 109, 103, 77],
        [24, 35, 55, 64, 81, 104, 113, 92],
        [49, 64, 78, 87, 103, 121, 120, 101],
        [72, 92, 95, 98, 112, 100, 103, 99],
    ],
    np.float32,
)


def jpeg_luminance(picture: Float, quality: int) -> Float:
    """What baseline JPEG (ITU T.81, annex K table) leaves of (H, W) grey levels 0-255; sides are multiples of 8."""
    height, width = picture.shape
    if height % 8 or width % 8:
        raise ValueError(f"the picture is {width} x {height} but multiples of 8 are needed")
    factor = 5000 / quality if quality < 50 else 200 - 2 * quality
    table = np.clip(np.floor((_JPEG_TABLE * factor + 50) / 100), 1, 255)
    blocks = np.asarray(picture, np.float32).reshape(height // 8, 8, width // 8, 8).transpose(0, 2, 1, 3) - 128
    coefficients = np.round(fft.dctn(blocks, axes=(2, 3), norm="ortho") / table) * table
    back = fft.idctn(coefficients, axes=(2, 3), norm="ortho") + 128
    return np.clip(np.round(back.transpose(0, 2, 1, 3).reshape(height, width)), 0, 255)
