"""Streamed SOG: a tree in lod-meta.json whose leaves refer to parts of SOGs, for each level of detail.

Public description: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats (streamed SOG). Level 0 is
the finest; each leaf is read at its finest level.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import PurePosixPath

import numpy as np

from egs_warp.errors import UserError
from egs_warp.io.raw import RawCapture
from egs_warp.io.sog import SogFiles, SogMeta, decode_sog


def decode_streamed_sog(meta_json: bytes, files: SogFiles) -> RawCapture:
    """Concatenate the Gaussians of all leaves at their finest level. Raises ``UserError`` for a malformed tree or an
    incomplete capture."""
    meta = SogMeta(meta_json, files.source)
    names, tree = meta.entry("filenames"), meta.entry("tree")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names) or not isinstance(tree, dict):
        raise UserError(f"{files.source}: lod-meta.json has no filenames and tree; export the capture again")
    if len({PurePosixPath(name) for name in names}) < len(names):
        raise UserError(f"{files.source}: lod-meta.json names a file twice; export the capture again")
    ranges: dict[int, list[tuple[int, int]]] = {}
    for file, start, count in _leaves(tree, files):
        if file >= len(names):
            raise UserError(
                f"{files.source}: lod-meta.json refers to file {file}, counted from 0, but lists only"
                f" {len(names)}; export it again"
            )
        ranges.setdefault(file, []).append((start, start + count))
    if not ranges:
        raise UserError(f"{files.source}: it has no Gaussians; export it again from the tool that made it")
    parts = [_part(files, names[file], ranges[file]) for file in sorted(ranges)]
    return _concatenated(parts, antialiased=meta.antialiased or all(part.antialiased for part in parts))


def _leaves(tree: dict, files: SogFiles) -> Iterator[tuple[int, int, int]]:
    """Yield (file, first Gaussian, count) of each leaf at its finest level, in the tree's order."""
    stack: list[object] = [tree]
    while stack:
        node = stack.pop()
        levels = node.get("lods") if isinstance(node, dict) else None
        children = node.get("children", []) if isinstance(node, dict) else None
        if not isinstance(children, list) or not isinstance(levels, dict | None):
            raise UserError(f"{files.source}: malformed tree in lod-meta.json; export the capture again")
        stack.extend(reversed(children))
        known = [level for level in levels or {} if re.fullmatch(r"[0-9]{1,4}", level)]
        if known:
            leaf = (levels or {})[min(known, key=int)]
            values = [leaf.get(key) for key in ("file", "offset", "count")] if isinstance(leaf, dict) else []
            numbers = [value for value in values if isinstance(value, int) and value >= 0]
            if len(numbers) < 3:
                raise UserError(f"{files.source}: malformed leaf in lod-meta.json; export the capture again")
            yield numbers[0], numbers[1], numbers[2]


def _part(files: SogFiles, name: str, ranges: list[tuple[int, int]]) -> RawCapture:
    folder = PurePosixPath(name).parent
    if PurePosixPath(name).name != "meta.json":
        raise UserError(f"{files.source}: lod-meta.json names {name!r}, expected a meta.json; export the capture again")
    part = decode_sog(files.read(name), SogFiles(files.source, lambda file: files.read(str(folder / file))))
    needed = max(end for _, end in ranges)
    if needed > len(part.means):
        raise UserError(
            f"{files.source}: truncated: {name} has {len(part.means)} Gaussians, expected at least {needed}; export the"
            " capture again"
        )
    # Check this before allocating indices, because a crafted file may contain many overlapping leaves.
    if sum(end - start for start, end in ranges) > len(part.means):
        raise UserError(f"{files.source}: leaves of {name} overlap in lod-meta.json; export the capture again")
    chosen = np.concatenate([np.arange(start, end) for start, end in ranges])
    return RawCapture(
        format=part.format,
        means=part.means[chosen],
        rotations=part.rotations[chosen],
        log_scales=part.log_scales[chosen],
        opacity_logits=part.opacity_logits[chosen],
        sh=part.sh[chosen],
        antialiased=part.antialiased,
        notes=part.notes,
    )


def _concatenated(parts: list[RawCapture], *, antialiased: bool) -> RawCapture:
    coefficients = max(part.sh.shape[1] for part in parts)
    sh = [np.pad(part.sh, ((0, 0), (0, coefficients - part.sh.shape[1]), (0, 0))) for part in parts]
    return RawCapture(
        format="streamed SOG",
        means=np.concatenate([part.means for part in parts]),
        rotations=np.concatenate([part.rotations for part in parts]),
        log_scales=np.concatenate([part.log_scales for part in parts]),
        opacity_logits=np.concatenate([part.opacity_logits for part in parts]),
        sh=np.concatenate(sh),
        antialiased=antialiased,
        notes=("finest level of detail", *dict.fromkeys(note for part in parts for note in part.notes)),
    )
