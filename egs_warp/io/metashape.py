"""Cameras of Agisoft Metashape (*Export Cameras*, .xml).

The ``transform`` of a camera maps OpenCV axes to the chunk, and the ``transform`` of the chunk or component maps the
chunk to the world. The appendix of the user manual describes the lens model; its P1 and P2 are OpenCV's p2 and p1.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egs_warp.errors import UserError
from egs_warp.geometry.lens import Lens
from egs_warp.io.limits import MAX_TEXT_BYTES, read_bytes
from egs_warp.io.photo_files import PhotoAndMask, PhotoFiles
from egs_warp.io.posed_images import (
    ExcludedPhoto,
    PosedImage,
    camera_of_photo,
    convert_each,
    is_rotation,
)

_TYPES = {"frame": False, "fisheye": True, "equidistant_fisheye": True}
"""Supported types of sensors. The value is True if the argument of the distortion polynomial is the angle."""
_MAX_SKEW = 1.0
"""Skew, in pixels, up to which it is ignored without a note."""
_EXPORT = "export the cameras again as XML"


def read_metashape(source: Path, files: PhotoFiles) -> tuple[list[PosedImage], list[ExcludedPhoto], list[str]]:
    """Read the aligned cameras of a .xml, and find their photos and masks in ``files``.

    If there are several chunks, the one with the most aligned cameras is read. Returns the photos with valid cameras,
    the excluded photos, and notes for the user. Raises ``UserError`` for a file that is malformed or has no valid
    camera.
    """
    data = read_bytes(source, at_most=MAX_TEXT_BYTES)
    # A document type declaration can define entities that expand to any size.
    if b"<!DOCTYPE" in data.replace(b"\0", b""):
        raise UserError(f"{source}: it has a document type declaration, which Metashape does not write; {_EXPORT}")
    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise UserError(f"{source}: not readable XML ({error}); {_EXPORT}") from error
    chunks = [chunk for chunk in root.iter("chunk") if chunk.find("cameras") is not None]
    if root.tag != "document" or not chunks:
        raise UserError(f"{source}: it has no chunk with cameras; {_EXPORT}")
    notes = []
    chunk = max(chunks, key=lambda one: sum(camera.find("transform") is not None for camera in one.iter("camera")))
    if len(chunks) > 1:
        label = repr(chunk.get("label", ""))
        notes.append(f"of {len(chunks)} chunks, the one with the most aligned cameras is used: {label}")
    cameras = list(chunk.iter("camera"))
    names = [camera.get("label") or f"camera {camera.get('id')}" for camera in cameras]
    places = files.locate(names, (source.parent / "images", source.parent))
    sensors = {sensor.get("id"): sensor for sensor in chunk.iter("sensor")}
    frames = {
        component.get("id"): frame
        for component in chunk.iter("component")
        if (frame := component.find("transform")) is not None
    }
    entries = [
        _Entry(
            f"{source}: camera {name}",
            name,
            camera,
            sensors.get(camera.get("sensor_id")),
            frames.get(camera.get("component_id"), chunk.find("transform")),
            place,
        )
        for name, camera, place in zip(names, cameras, places, strict=True)
    ]
    empty = f"{source}: it has no cameras; {_EXPORT}"
    images, excluded = convert_each(((entry.name, entry) for entry in entries), _posed, empty)
    skew = max((abs(_calibration_number(sensor, "b2")) for sensor in sensors.values()), default=0.0)
    if skew > _MAX_SKEW:
        notes.append(f"the skew b2 of {skew:g} pixels is ignored; export undistorted photos if that matters")
    higher = max((abs(_calibration_number(one, name)) for one in sensors.values() for name in ("p3", "p4")), default=0)
    if higher > 0.0:
        notes.append(f"p3 and p4, which are up to {higher:g}, are ignored; export undistorted photos if that matters")
    return images, excluded, notes


@dataclass(frozen=True)
class _Entry:
    where: str
    name: str
    camera: ElementTree.Element
    sensor: ElementTree.Element | None
    frame: ElementTree.Element | None
    """Transform of the component or chunk; None for the identity."""
    place: PhotoAndMask


def _posed(entry: _Entry) -> PosedImage:
    if entry.camera.get("enabled") in ("0", "false"):
        raise UserError(f"{entry.where} is disabled; enable it and {_EXPORT}")
    if entry.camera.find("transform") is None:
        raise UserError(f"{entry.where} is not aligned; align the photos, and {_EXPORT}")
    pose = _numbers(entry.camera, "transform", 16, entry.where).reshape(4, 4)
    turn, shift, scale = np.eye(3), np.zeros(3), 1.0
    if entry.frame is not None:
        turn = _numbers(entry.frame, "rotation", 9, entry.where, default=np.eye(3)).reshape(3, 3)
        shift = _numbers(entry.frame, "translation", 3, entry.where, default=np.zeros(3))
        scale = float(_numbers(entry.frame, "scale", 1, entry.where, default=np.ones(1))[0])
    rotation = (turn @ pose[:3, :3]).T
    if not is_rotation(rotation) or not is_rotation(turn) or scale <= 0.0:
        raise UserError(f"{entry.where}: its transform is not a rotation with a positive scale; {_EXPORT}")
    centre = scale * turn @ pose[:3, 3] + shift
    camera, lens = _intrinsics(entry)
    camera = camera_of_photo(entry.where, **camera, rotation=rotation, translation=-rotation @ centre)
    return PosedImage(entry.name, camera, entry.place.image, lens, entry.place.mask, entry.place.missing)


def _intrinsics(entry: _Entry) -> tuple[dict, Lens | None]:
    """Return size, focal lengths and principal point of the sensor, and its lens."""
    sensor = entry.sensor
    calibration = _calibration(sensor)
    if sensor is None or calibration is None:
        raise UserError(f"{entry.where} has no calibrated sensor; {_EXPORT}")
    kind = calibration.get("type", sensor.get("type", "frame"))
    if kind not in _TYPES:
        raise UserError(f"{entry.where} has a sensor of type {kind!r}; give one of {', '.join(_TYPES)}")
    resolution = calibration.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    try:
        assert resolution is not None
        width, height = int(resolution.get("width", "")), int(resolution.get("height", ""))
    except (AssertionError, ValueError):
        raise UserError(f"{entry.where} has a sensor without resolution; {_EXPORT}") from None
    number = {
        name: _calibration_number(sensor, name)
        for name in ("f", "fx", "fy", "cx", "cy", "b1", "k1", "k2", "k3", "k4", "p1", "p2")
    }
    wrong = [name for name, value in number.items() if not np.isfinite(value)]
    if wrong or width < 1 or height < 1:
        what = f"{', '.join(wrong)} not finite" if wrong else f"{width} x {height} pixels"
        raise UserError(f"{entry.where} has a sensor with invalid numbers ({what}); {_EXPORT}")
    # Files of versions up to 1.2 have two focal lengths, the position of the principal point instead of its offset from
    # the middle, and p1 and p2 in OpenCV's order.
    is_old = calibration.find("fx") is not None
    intrinsics = {
        "width": width,
        "height": height,
        "fx": number["fx"] if is_old else number["f"] + number["b1"],
        "fy": number["fy"] if is_old else number["f"],
        "cx": number["cx"] + (0.0 if is_old else width / 2.0),
        "cy": number["cy"] + (0.0 if is_old else height / 2.0),
    }
    tangential = (number["p1"], number["p2"]) if is_old else (number["p2"], number["p1"])
    radial = (number["k1"], number["k2"], number["k3"], number["k4"])
    lens = Lens(fisheye=_TYPES[kind], radial=radial, tangential=tangential)
    return intrinsics, lens if lens.is_distorted else None


def _calibration(sensor: ElementTree.Element | None) -> ElementTree.Element | None:
    """Return the calibration of a sensor; if there are several, the adjusted one."""
    found = [] if sensor is None else sensor.findall("calibration")
    return next((one for one in found if one.get("class") == "adjusted"), found[0] if found else None)


def _calibration_number(sensor: ElementTree.Element | None, name: str) -> float:
    """Return the value ``name`` of the calibration; 0 if it is missing, NaN if it is not a number."""
    calibration = _calibration(sensor)
    text = None if calibration is None else calibration.findtext(name)
    try:
        return 0.0 if text is None else float(text)
    except ValueError:
        return np.nan


def _numbers(
    parent: ElementTree.Element, name: str, count: int, where: str, *, default: np.ndarray | None = None
) -> np.ndarray:
    """Return the ``count`` values of the child ``name``; ``default`` if there is none."""
    text = parent.findtext(name)
    if text is None and default is not None:
        return default
    try:
        values = np.array([float(word) for word in (text or "").split()])
    except ValueError:
        values = np.array([np.nan])
    if len(values) != count or not np.isfinite(values).all():
        raise UserError(f"{where}: its {name} {(text or '')[:60]!r} is not {count} finite numbers; {_EXPORT}")
    return values
