"""Reading of captures of all supported formats."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import warp as wp

from egs_warp.errors import UserError
from egs_warp.geometry.gaussians import ARRAYS, GaussianCloud
from egs_warp.io.compressed_ply import decode_compressed_ply, is_compressed
from egs_warp.io.gltf import decode_glb, decode_gltf, is_glb
from egs_warp.io.limits import FREE_BYTES, INFLATION, MAX_TEXT_BYTES, read_bytes
from egs_warp.io.origin import relative_positions
from egs_warp.io.other_kinds import other_file, other_folder
from egs_warp.io.outliers import without_not_finite, without_outliers
from egs_warp.io.paths import stays_inside
from egs_warp.io.ply import decode_ply, read_header
from egs_warp.io.raw import EXTREME_LOGIT, RawCapture
from egs_warp.io.sog import SogFiles, decode_sog
from egs_warp.io.splat import SPLAT_ROW, decode_splat
from egs_warp.io.spz import decode_spz
from egs_warp.io.streamed_sog import decode_streamed_sog

_META, _STREAMED_META = "meta.json", "lod-meta.json"


@dataclass(frozen=True, kw_only=True)
class Capture(GaussianCloud):
    """A capture as read from a file: a cloud, and metadata of the file. Positions are in the axes and units of the
    file, relative to ``origin``."""

    source: Path
    format: str
    """Name of the format for the user, such as ``.spz version 2``."""
    infinite_opacities: int
    """Number of Gaussians whose opacity logit in the file is infinite (opacity 0 or 1) or beyond 500 in magnitude; such
    logits are read as -16 or +16. It is 0 for formats that store opacity in a byte, whose 0 and 255 represent
    ranges."""
    up: np.ndarray | None
    """(3,) float64 unit vector if the format or the file defines the up direction, else None."""
    vertical_axis: int | None
    """Index of the vertical axis, if the file specifies one without a reliable sign."""
    notes: tuple[str, ...]
    """Notes for the user on Gaussians that were left out, and on values that were repaired or rounded."""
    origin: np.ndarray | None = None
    """(3,) float64, file units: offset of a georeferenced capture, which was subtracted from its positions."""
    rows: np.ndarray | None = None
    """(n,) indices of the Gaussians in the file; None if all of them were read in order."""

    def __repr__(self) -> str:
        return f"Capture({self.source.name!r}, {self.format}: {self.count:,} Gaussians, SH degree {self.sh_degree})"

    @property
    def cloud(self) -> GaussianCloud:
        """Return the Gaussians without the metadata."""
        arrays = (self.means, self.rotations, self.log_scales, self.opacity_logits, self.sh)
        return GaussianCloud(*arrays, antialiased=self.antialiased)

    def cloud_aligned_with(self, other: Capture) -> GaussianCloud:
        """Return the Gaussians without the metadata, relative to the origin of ``other`` if both captures have one."""
        if self.origin is None or other.origin is None or np.array_equal(self.origin, other.origin):
            return self.cloud
        means = self.means.numpy() + (self.origin - other.origin)
        return replace(self.cloud, means=wp.array(means, dtype=wp.vec3, device=self.device))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the cloud and the metadata."""
        arrays = (*ARRAYS, "antialiased")
        facts = {one.name: getattr(self, one.name) for one in fields(self) if one.name not in arrays}
        return _capture, (self.cloud, facts)

    def subset(self, chosen: np.ndarray) -> Capture:
        """Return the Gaussians that a boolean mask or an index array selects, with the metadata.

        Raises ``UserError`` if it selects none.
        """
        rows = np.arange(self.count) if self.rows is None else self.rows
        return self.with_cloud(self.cloud.subset(chosen), rows=rows[chosen])

    def with_cloud(self, cloud: GaussianCloud, **changes: Any) -> Capture:
        """Return the capture with the Gaussians of ``cloud`` and other ``changes`` of its fields."""
        return replace(self, **{name: getattr(cloud, name) for name in (*ARRAYS, "antialiased")}, **changes)


def _capture(cloud: GaussianCloud, facts: dict[str, Any]) -> Capture:
    """Return the capture with the Gaussians of ``cloud`` and the other fields ``facts``."""
    return Capture(**{name: getattr(cloud, name) for name in (*ARRAYS, "antialiased")}, **facts)


def read_capture(path: Path | str, *, device: str | None = None) -> Capture:
    """Read an INRIA or PlayCanvas compressed .ply, .spz, .splat, .sog, an unbundled SOG (its folder or meta.json), or
    glTF with splats (.glb, .gltf).

    The format is detected by content, except that .splat, which has no magic number, and .gltf are detected by name.
    Raises ``UserError`` with one line for anything that cannot be read.
    """
    source = Path(path)
    # Suppress warnings about values that are not finite or too large for float32; such values are reported below.
    with np.errstate(over="ignore", invalid="ignore"):
        raw = _decode(source)
    raw = without_outliers(without_not_finite(raw, source), source)
    infinite = np.isinf(raw.opacity_logits)
    infinite_count = int(np.count_nonzero(infinite))
    means, origin, rounding = relative_positions(raw.means)
    if raw.origin is not None:
        origin = raw.origin if origin is None else raw.origin + origin
    notes = (*raw.notes, *rounding)
    if infinite_count:
        notes = (*notes, f"{infinite_count} infinite opacities were read as 0 or 1")
    cloud = GaussianCloud.from_numpy(
        means,
        raw.rotations,
        raw.log_scales,
        np.where(infinite, np.copysign(np.float32(EXTREME_LOGIT), raw.opacity_logits), raw.opacity_logits),
        raw.sh,
        antialiased=raw.antialiased,
        device=device,
    )
    return Capture(
        *(cloud.means, cloud.rotations, cloud.log_scales, cloud.opacity_logits, cloud.sh),
        antialiased=cloud.antialiased,
        source=source,
        format=raw.format,
        infinite_opacities=infinite_count,
        up=raw.up,
        vertical_axis=raw.vertical_axis,
        notes=notes,
        origin=origin,
        rows=raw.rows,
    )


def _decode(source: Path) -> RawCapture:
    if source.is_dir():
        return _decode_folder(source)
    data = read_bytes(source)
    if data[:4] in (b"ply\n", b"ply\r"):
        header = read_header(data, source)
        return (decode_compressed_ply if is_compressed(header) else decode_ply)(data, header, source)
    if _may_be_splat(data, source):
        return decode_splat(data, source)
    if data[:2] == b"\x1f\x8b" or data[:4] == b"NGSP":
        return decode_spz(data, source)
    other = other_file(source, data)
    if data[:2] == b"PK" and other is None:
        del data
        return _decode_zip(source)
    if is_glb(data):
        return decode_glb(data, source)
    if data[:1] == b"{" and source.suffix.lower() == ".gltf":
        return decode_gltf(read_bytes(source, at_most=MAX_TEXT_BYTES), source)
    if data[:1] == b"{" and other is None:
        return _decode_meta(source)
    if not data:
        raise UserError(f"{source}: the file is empty; copy or export it again")
    if source.suffix.lower() == ".splat":
        return decode_splat(data, source)
    if other is not None:
        raise UserError(f"{source}: {other}")
    raise UserError(
        f"{source}: unknown format (starts with {data[:8]!r}); give a .ply, .spz, .splat, .sog, .glb or a SOG folder"
    )


_MAGIC_NUMBERS = (b"NGSP", b"glTF", b"PK\x03\x04", b"\x1f\x8b\x08")
"""Magic numbers of other formats, which the first coordinate of a .splat equals only by a rare coincidence."""


def _may_be_splat(data: bytes, source: Path) -> bool:
    """Return True if a file named .splat may be one. The format has no magic number: its first bytes are a coordinate,
    which may happen to equal the first bytes of zip, gzip or JSON."""
    whole = len(data) > 0 and len(data) % SPLAT_ROW == 0
    text = data[:1] == b"{" and data[:SPLAT_ROW].isascii() and b"\0" not in data[:SPLAT_ROW]
    return source.suffix.lower() == ".splat" and whole and not text and not data.startswith(_MAGIC_NUMBERS)


def _decode_folder(folder: Path) -> RawCapture:
    for name in (_META, _STREAMED_META):
        if (folder / name).is_file():
            return _decode_meta(folder / name)
    nested = sorted(path for path in folder.glob(f"*/{_META}") if path.is_file())
    if len(nested) == 1:
        return _decode_meta(nested[0])
    why = other_folder(folder) or "the folder has no meta.json; give an unbundled SOG folder or a capture file"
    raise UserError(f"{folder}: {why}")


def _decode_meta(meta: Path) -> RawCapture:
    def read(name: str) -> bytes:
        return read_bytes(meta.parent / _inside(name, meta))

    return _decode_sog_or_streamed(meta, read_bytes(meta, at_most=MAX_TEXT_BYTES), read)


def _decode_zip(source: Path) -> RawCapture:
    # zipfile raises a dozen classes of errors for corrupted archives; the user needs only one.
    try:
        with zipfile.ZipFile(source) as archive:
            members = {info.filename: info for info in archive.infolist() if not info.is_dir()}
            metas = [name for name in members if PurePosixPath(name).name in (_META, _STREAMED_META)]
            metas.sort(key=lambda name: (name.count("/"), name))
            if not metas:
                raise UserError(
                    f"{source}: the zip has no meta.json; give a .sog, or unpack it if it holds another capture"
                )

            # Inflate only requested members, and only up to the checked size.
            def read(name: str) -> bytes:
                inside = str(PurePosixPath(metas[0]).parent / _inside(name, source))
                if inside not in members:
                    raise UserError(f"{source}: {inside} is missing from the zip; copy or export the file again")
                member = members[inside]
                text = PurePosixPath(inside).suffix == ".json"
                if member.file_size > (MAX_TEXT_BYTES if text else INFLATION * member.compress_size + FREE_BYTES):
                    raise UserError(
                        f"{source}: {inside} inflates from {member.compress_size} to {member.file_size} bytes, which is"
                        " more than a capture needs; export it again"
                    )
                return archive.read(member)

            return _decode_sog_or_streamed(source, read(PurePosixPath(metas[0]).name), read)
    except (UserError, MemoryError):
        raise
    except Exception as error:
        raise UserError(f"{source}: corrupted zip ({error}); copy or export the file again") from error


def _decode_sog_or_streamed(source: Path, meta: bytes, read: Callable[[str], bytes]) -> RawCapture:
    files = SogFiles(source, read)
    return decode_streamed_sog(meta, files) if b'"lodLevels"' in meta else decode_sog(meta, files)


def _inside(name: str, source: Path) -> PurePosixPath:
    if not stays_inside(name):
        raise UserError(f"{source}: meta.json names {name!r}, which lies outside the capture; export it again")
    return PurePosixPath(name)
