"""Cloud of 3D Gaussians on one Warp device."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation
from scipy.special import expit, logit, ndtr

from egs_warp.checked_calls import checked_method
from egs_warp.errors import ArgumentError, UserError
from egs_warp.geometry.plane import Plane
from egs_warp.launching import device_of, start_on_cpu

SH_BAND_0 = 0.28209479177387814
"""Spherical harmonic of band 0: without higher bands, a colour is 1/2 + SH_BAND_0 times the coefficient of band 0."""
ARRAYS = ("means", "rotations", "log_scales", "opacity_logits", "sh")
"""Names of a cloud's arrays, in the order of its constructor."""
_TRANSPARENT_LOGIT = -16.0
"""Opacity logit of a hidden Gaussian: its opacity of 1e-7 is too low for any renderer to draw it."""
_THIRD_BELOW = 0.43
"""Height of the mean of a normal distribution above a plane that a third of it lies below, in standard deviations."""
_CUT_DEVIATIONS = 2.0
"""Maximum distance between a plane and the mean of a Gaussian that is cut at the plane, in standard deviations."""
MAX_VALUE, MAX_LOG_SCALE = 1e18, 41.0
"""Maximum magnitude of any value of a cloud, and maximum logarithm of a standard deviation: squares of numbers within
these limits are finite in single precision."""


@dataclass(frozen=True)
class GaussianCloud:
    """A 3DGS capture. All arrays live on one device; ``wp.to_torch`` gives torch views without copies."""

    means: wp.array
    """(n,) vec3, scene units; metres in the frame of a body."""
    rotations: wp.array
    """(n,) vec4, unit quaternions w, x, y, z."""
    log_scales: wp.array
    """(n,) vec3, natural logarithm of the standard deviation along each axis."""
    opacity_logits: wp.array
    """(n,) float32, finite logits of the opacities."""
    sh: wp.array
    """(n, (degree+1)^2) vec3: real spherical-harmonic coefficients of colour, band 0 first, in the INRIA convention."""
    antialiased: bool = False
    """True if the capture was trained with antialiasing (the filters of Mip-Splatting, gsplat's ``antialiased``). The
    renderer then divides the opacity of each splat by the factor by which the low-pass filter increases its area."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.count:,} Gaussians, SH degree {self.sh_degree})"

    @classmethod
    @checked_method
    def from_numpy(
        cls,
        means: np.ndarray,
        rotations: np.ndarray,
        log_scales: np.ndarray,
        opacity_logits: np.ndarray,
        sh: np.ndarray,
        *,
        antialiased: bool = False,
        device: str | None = None,
    ) -> GaussianCloud:
        """Upload means (n, 3), rotations (n, 4), log scales (n, 3), opacity logits (n,) and SH coefficients (n, K, 3);
        quaternions are normalised.

        Raises ``UserError`` for zero Gaussians, for mismatched counts, and for a value that is not finite or exceeds
        ``MAX_VALUE``; the message names the value.
        """
        if device in (None, "cpu"):
            start_on_cpu()
        count = len(means)
        if count == 0:
            raise UserError("capture: it has no Gaussians; export it again from the tool that made it")
        named = {
            "means": (means, (count, 3)),
            "rotations": (rotations, (count, 4)),
            "log_scales": (log_scales, (count, 3)),
            "opacity_logits": (opacity_logits, (count,)),
            "sh": (sh, (count, np.shape(sh)[1] if np.ndim(sh) == 3 else -1, 3)),
        }
        for name, (values, shape) in named.items():
            if np.shape(values) != shape:
                raise UserError(f"capture: {name} has shape {np.shape(values)}, expected {shape}; export it again")
            # Quaternions have no limit, because their length is irrelevant.
            limit = {"log_scales": MAX_LOG_SCALE, "rotations": np.inf}.get(name, MAX_VALUE)
            floor = -np.inf if name == "log_scales" else -limit
            # Minimum and maximum are NaN if any value is NaN. The first faulty Gaussian is searched for only if there
            # is one.
            lowest, highest = np.min(values, initial=0.0), np.max(values, initial=0.0)
            if np.isfinite(lowest) and np.isfinite(highest) and floor <= lowest and highest <= limit:
                continue
            not_finite = np.flatnonzero(~np.isfinite(values).reshape(count, -1).all(axis=1))
            if len(not_finite):
                raise UserError(
                    f"capture: {name} of {len(not_finite)} Gaussians is not finite (first: number {not_finite[0]}); "
                    "remove them and export again"
                )
            rows = np.reshape(values, (count, -1))
            too_large = (rows.max(axis=1) > limit) | (rows.min(axis=1) < floor)
            raise UserError(
                f"capture: {name} of {np.count_nonzero(too_large)} Gaussians is too large for single precision"
                f" (first: number {np.argmax(too_large)}); remove them and export again"
            )
        if np.shape(sh)[1] not in (1, 4, 9, 16):
            raise UserError(
                f"capture: {np.shape(sh)[1]} SH coefficients, expected 1, 4, 9 or 16; export it with degree 0 to 3"
            )

        def upload(values: np.ndarray, dtype: type) -> wp.array:
            return wp.array(np.ascontiguousarray(values, dtype=np.float32), dtype=dtype, device=device)

        return cls(
            means=upload(means, wp.vec3),
            rotations=upload(unit_quaternions(rotations), wp.vec4),
            log_scales=upload(log_scales, wp.vec3),
            opacity_logits=upload(opacity_logits, wp.float32),
            sh=upload(sh, wp.vec3),
            antialiased=antialiased,
        )

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the arrays as NumPy arrays, and the name of the device."""
        build = partial(GaussianCloud.from_numpy, antialiased=self.antialiased, device=str(self.device))
        return build, tuple(getattr(self, name).numpy() for name in ARRAYS)

    @property
    def count(self) -> int:
        """Number of Gaussians n."""
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """SH degree, 0 to 3."""
        return round(self.sh.shape[1] ** 0.5) - 1

    @property
    def device(self) -> wp.Device:
        """The Warp device of every array."""
        return device_of(self.means)

    def opacities(self) -> np.ndarray:
        """Return the opacities (n,) float64 on the host, 0 to 1."""
        with np.errstate(over="ignore"):
            return 1.0 / (1.0 + np.exp(-self.opacity_logits.numpy().astype(np.float64)))

    def visible(self, opacity: float) -> np.ndarray:
        """Return the mask (n,) bool of the Gaussians with an opacity of at least ``opacity``; if these have less than
        half of the total opacity, of the most opaque Gaussians that have half of it.

        If photos are trained with more Gaussians than the object has pixels, a surface consists of many layers of
        Gaussians, each of which has an opacity of a few percent.
        """
        opacities = self.opacities()
        if len(opacities) == 0:
            return np.zeros(0, bool)
        in_order = np.sort(opacities)
        mass = np.cumsum(in_order)
        return opacities >= min(opacity, float(in_order[np.searchsorted(mass, 0.5 * mass[-1])]))

    def breadths(self, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Return the middle one of the three standard deviations (m,) float64 of the Gaussians ``rows``, on the host,
        scene units. For a flat Gaussian, this is its smaller extent within its plane."""
        return np.exp(np.median(self.log_scales.numpy()[rows].astype(np.float64), axis=1))

    def scaled(self, factor: float) -> GaussianCloud:
        """Return the same capture with every length multiplied by ``factor``."""
        return GaussianCloud.from_numpy(
            self.means.numpy() * factor,
            self.rotations.numpy(),
            self.log_scales.numpy() + np.log(factor),
            self.opacity_logits.numpy(),
            self.sh.numpy(),
            antialiased=self.antialiased,
            device=str(self.device),
        )

    def subset(self, chosen: np.ndarray) -> GaussianCloud:
        """Return the Gaussians that a boolean mask or an index array selects.

        Raises ``UserError`` if it selects none.
        """
        means = self.means.numpy()[chosen]
        if len(means) == 0:
            raise UserError(f"selection: it contains none of the {self.count} Gaussians; select at least one")
        return GaussianCloud.from_numpy(
            means,
            self.rotations.numpy()[chosen],
            self.log_scales.numpy()[chosen],
            self.opacity_logits.numpy()[chosen],
            self.sh.numpy()[chosen],
            antialiased=self.antialiased,
            device=str(self.device),
        )


def unit_quaternions(quaternions: np.ndarray) -> np.ndarray:
    """Return ``quaternions`` (n, 4), w first, normalised to float32; zero quaternions become the identity.

    Quaternions that are normalised up to rounding keep their bits, so that repeated copies of a capture are identical.
    """
    lengths = np.sqrt(np.einsum("ni,ni->n", quaternions, quaternions, dtype=np.float64))
    far = ~np.isfinite(lengths) | (lengths < 1e-150)
    if far.any():
        # Rescale doubles whose squares overflow or underflow, and zeros.
        largest = np.abs(quaternions[far]).max(axis=1, keepdims=True)
        quaternions = np.array(quaternions, dtype=np.float64)
        quaternions[far] /= np.where(largest > 0.0, largest, 1.0)
        lengths[far] = np.linalg.norm(quaternions[far], axis=1)
    not_unit = np.abs(lengths - 1.0) > 2.0**-22
    unit = np.array(quaternions, dtype=np.float32)
    unit[not_unit] = quaternions[not_unit] / np.maximum(lengths[not_unit], 1e-300)[:, None]
    unit[lengths == 0.0] = (1.0, 0.0, 0.0, 0.0)
    return unit


def concatenate(*clouds: GaussianCloud) -> GaussianCloud:
    """Return one cloud with the Gaussians of all ``clouds`` in turn; all must have the same SH degree.

    The result is marked as antialiased if all of them are.
    """

    degrees = {cloud.sh.shape[1] for cloud in clouds}
    if len(degrees) != 1:
        problem = f"with {' and '.join(map(str, sorted(degrees)))} SH coefficients" if clouds else "none"
        raise ArgumentError("clouds", "give at least one, all of one SH degree", value=problem)

    def stack(name: str) -> np.ndarray:
        return np.concatenate([getattr(cloud, name).numpy() for cloud in clouds])

    return GaussianCloud.from_numpy(
        stack("means"),
        stack("rotations"),
        stack("log_scales"),
        stack("opacity_logits"),
        stack("sh"),
        antialiased=all(cloud.antialiased for cloud in clouds),
        device=str(clouds[0].device),
    )


def hidden_below(cloud: GaussianCloud, plane: Plane, *, margin: float) -> GaussianCloud:
    """Return ``cloud`` with the Gaussians below ``plane`` made transparent; number and order do not change.

    A Gaussian is below the plane if its mean is more than ``margin`` (world units) below it, or if a third of its mass
    is below the plane and the point one standard deviation below its mean is deeper than two margins.
    """
    heights = plane.heights(cloud.means.numpy())
    axes = Rotation.from_quat(cloud.rotations.numpy()[:, [1, 2, 3, 0]]).as_matrix()
    along = np.einsum("i,nij->nj", plane.normal, axes) * np.exp(cloud.log_scales.numpy().astype(np.float64))
    spreads = np.linalg.norm(along, axis=1)
    below = (heights < -margin) | ((heights < _THIRD_BELOW * spreads) & (heights - spreads < -2.0 * margin))
    if not below.any():
        return cloud
    logits = np.where(below, np.float32(_TRANSPARENT_LOGIT), cloud.opacity_logits.numpy())
    return replace(cloud, opacity_logits=wp.array(logits, dtype=wp.float32, device=cloud.device))


def cut_at(cloud: GaussianCloud, plane: Plane) -> GaussianCloud:
    """Return ``cloud`` with each Gaussian that crosses ``plane`` replaced by a Gaussian for its part above the plane.

    The new Gaussian has the mean and the covariance of that part. With the distance h of the mean from the plane, the
    variance s^2 along the normal n of the plane, a = -h / s and l = phi(a) / (1 - Phi(a)),

        mean' = mean + l C n / s,    C' = C - l (l - a) (C n) (C n)^T / s^2.

    The opacity is multiplied by the fraction above the plane, 1 - Phi(a). Colours, number and order do not change.
    Gaussians of which less than 2 % are below the plane, and those with less than 2 % above it, remain as they are.
    """
    heights = plane.heights(cloud.means.numpy()).astype(np.float64)
    axes = Rotation.from_quat(cloud.rotations.numpy()[:, [1, 2, 3, 0]]).as_matrix()
    factors = axes * np.exp(cloud.log_scales.numpy().astype(np.float64))[:, None, :]
    along = np.einsum("i,nij->nj", plane.normal, factors)
    spreads = np.linalg.norm(along, axis=1)
    rows = np.flatnonzero(np.abs(heights) < _CUT_DEVIATIONS * spreads)
    if len(rows) == 0:
        return cloud
    ratio = -heights[rows] / spreads[rows]
    # scipy.stats.norm gives the same, but takes 0.4 s to import.
    above = ndtr(-ratio)
    hazard = np.exp(-0.5 * ratio**2) / np.sqrt(2.0 * np.pi) / above
    # (k, 3): C n / s.
    lean = np.einsum("nij,nj->ni", factors[rows], along[rows] / spreads[rows, None])
    covariances = factors[rows] @ factors[rows].transpose(0, 2, 1)
    covariances -= (hazard * (hazard - ratio))[:, None, None] * lean[:, :, None] * lean[:, None, :]
    variances, vectors = np.linalg.eigh(covariances)
    vectors[:, :, 0] *= np.linalg.det(vectors)[:, None]
    # The smallest axis of a flat Gaussian may have no variance left in double precision.
    variances = np.maximum(variances, np.exp(2.0 * cloud.log_scales.numpy()[rows].min(axis=1, keepdims=True) - 6.0))
    means, rotations, log_scales, logits = (getattr(cloud, name).numpy().copy() for name in ARRAYS[:4])
    means[rows] += hazard[:, None] * lean
    rotations[rows] = Rotation.from_matrix(vectors).as_quat()[:, [3, 0, 1, 2]]
    log_scales[rows] = 0.5 * np.log(variances)
    logits[rows] = logit(np.maximum(above * expit(logits[rows].astype(np.float64)), expit(_TRANSPARENT_LOGIT)))
    return GaussianCloud.from_numpy(
        means,
        rotations,
        log_scales,
        logits,
        cloud.sh.numpy(),
        antialiased=cloud.antialiased,
        device=str(cloud.device),
    )


def most_visible(cloud: GaussianCloud, count: int) -> GaussianCloud:
    """Return the ``count`` Gaussians with the largest products of opacity and area, in their original order; the cloud
    itself if it has at most ``count``."""
    if cloud.count <= count:
        return cloud
    log_areas = np.sort(cloud.log_scales.numpy().astype(np.float64), axis=1)[:, 1:].sum(axis=1)
    # The logarithm of the opacity, without overflow.
    visibility = log_areas - np.logaddexp(0.0, -cloud.opacity_logits.numpy().astype(np.float64))
    return cloud.subset(np.sort(np.argsort(-visibility, kind="stable")[:count]))


def with_degree(cloud: GaussianCloud, degree: int | None) -> GaussianCloud:
    """Return ``cloud`` with colour bands up to ``degree``; None keeps all of them."""
    if degree is None or degree >= cloud.sh_degree:
        return cloud
    return replace(cloud, sh=cloud.sh[:, : (degree + 1) ** 2].contiguous())
