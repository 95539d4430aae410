"""Search for the photos and masks of a data set.

The names of photos in a file of poses may be relative to different folders, contain paths of another machine, or have
another suffix than the actual file. A name is first looked up directly. If there is no such file, the file of the data
set whose path ends in the same parts is used, if there is exactly one.
"""

from __future__ import annotations

import os
import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePath

from egs_warp.io.paths import path_inside, stays_inside

UNREADABLE_SUFFIXES = (".heic", ".heif")
"""Suffixes of pictures that are found but cannot be decoded."""
PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp", ".jp2", ".avif", *UNREADABLE_SUFFIXES)
"""Suffixes of pictures."""
_ADDED_SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".JPG", ".webp")
"""Suffixes that are added to names without one."""
_PHOTO_FOLDERS = ("images", "image", "imgs", "photos", "rgb", "color", "colour", "input", "undistorted")
"""Folders of photos, in order of preference."""
_REDUCED = re.compile(r"(?:images|input|photos)_(\d{1,2})")
"""Pattern of the names of folders that contain photos downscaled by a factor."""
_NO_PHOTOS = re.compile(
    r"(?:^|[\W\d_])(?:masks?|mattes?|depths?|depth_?maps?|normal_?maps?|segment(?:s|ed|ations?)|thumbs?|thumbnails?|previews?)"
    r"(?:$|[\W\d_])",
    re.IGNORECASE,
)
"""Pattern of the names of folders whose pictures are not photos. It matches whole words."""
_MAY_BE_NO_PHOTOS = re.compile(r"(?:.*[\W\d_])?(normals?|alphas?)[\W\d_]*", re.IGNORECASE)
"""Pattern of the names of folders that may contain photos, too."""
_OWN_WORD = re.compile(r"(?<=.)[ ._-]?(?:normals?|alphas?)$|^(?:normals?|alphas?)[ ._-]?(?=.)")
"""Pattern of the part of the name of a picture in these folders that is not in the name of its photo."""
_MASK_FOLDERS = ("masks", "mask")
"""Folders of masks, in order of preference."""
_MASK_FOLDER = re.compile(r"(?:.*[_-])?(?:masks?|mattes?|segmentations?|alphas?)(?:[_-].*)?", re.IGNORECASE)
_MAY_BE_MASK = re.compile("mask|matte|segmentation|alpha", re.IGNORECASE)
"""Pattern that must match the name of a mask, or of its folder."""
_MASK_PREFIX = re.compile(r"mask[._-](?=.)")
"""Pattern of the text that precedes the photo's name in the name of a mask: mask_00.png for 00.jpg."""
_MASK_SUFFIX = re.compile(r"(?<=.)[._-]mask$")
"""Pattern of the text that follows the photo's name in the name of a mask: 00_mask.png for 00.jpg."""
_TOOL_SUFFIX = re.compile(r"(?<=.)[ ._-]?(?:mask|matte|seg|alpha|object)[a-z]*(?:[._-]?\d+)?$")
"""Pattern of the text that segmentation tools append to the photo's name: _mask, -seg.3, Object."""
_MAX_DEPTH = 5
"""Maximum depth of the searched folders below the data set."""
_MAX_FILES = 200_000
"""Maximum number of searched files."""


@dataclass(frozen=True)
class FoundFile:
    """Result of a search."""

    path: Path | None
    reason: str = ""
    """Reason why no path was found; empty if there is simply no such file."""
    by_name: bool = False
    """True if the file was not at the path stated in the poses but was found by its name."""


@dataclass(frozen=True)
class PhotoAndMask:
    """Files that belong to a posed photo."""

    image: Path | None
    mask: Path | None
    missing: str
    """Reason why the photo, or else its mask, was not found; empty if nothing specific is known."""


@dataclass(frozen=True)
class _Candidate:
    """A picture of the data set."""

    path: Path
    folders: tuple[str, ...]
    """Names in lower case of the folders that contain the picture, below the data set or below the folder of masks."""
    suffix: str
    rank: int
    """Rank of the picture's folder; the folder with the smallest rank is preferred."""
    base: tuple[str, ...] = ()
    """Folders above the folder of masks or, for a mask beside its photo, above the mask."""


class PhotoFiles:
    """Search among the pictures below the folder of a data set."""

    def __init__(self, root: Path, *, preferred: Sequence[str] = ()) -> None:
        """Create the search in ``root``; ``preferred`` are names of folders that take precedence."""
        self._root = root
        self._known_folders: dict[Path, bool] = {}
        self._known_mask_folders: dict[tuple[Path, int], list[tuple[Path, int]]] = {}
        self._order = (*preferred, *(name for name in _PHOTO_FOLDERS if name not in preferred))

    def locate(
        self, names: Sequence[str], folders: Sequence[Path], masks: Sequence[str] | None = None
    ) -> list[PhotoAndMask]:
        """Find photos and masks.

        Args:
            names: names of the photos in the file of poses.
            folders: folders to which the names are relative, in order of preference.
            masks: names of the masks, relative to the first folder; empty texts for masks without a name, which are
                looked up by the name of their photo.
        """
        located = []
        for number, (name, photo) in enumerate(zip(names, self.find_photos(names, folders), strict=True)):
            if photo.path is None:
                located.append(PhotoAndMask(None, None, photo.reason))
            elif masks is not None and masks[number]:
                mask = self.find_named_mask(masks[number], folders[0])
                by_photo = FoundFile(None) if mask.path else self.find_mask(photo.path, 1)
                mask = by_photo if by_photo.path else mask
                located.append(PhotoAndMask(photo.path, mask.path, mask.reason))
            else:
                mask = self.find_mask(photo.path, 1 if photo.by_name else len(Path(name).parts))
                located.append(PhotoAndMask(photo.path, mask.path, mask.reason))
        return located

    def find_photos(self, names: Sequence[str], folders: Sequence[Path]) -> list[FoundFile]:
        """Find the photos ``names``, which should be relative to one of ``folders``."""
        found = [self._direct(name, folders) for name in names]
        # A photo that cannot be decoded may have a converted copy with the same stem.
        found = [None if path and path.suffix.lower() in UNREADABLE_SUFFIXES else path for path in found]
        if None not in found:
            return [FoundFile(path) for path in found]
        taken = {path for path in found if path is not None}
        stems = Counter(_parts(name)[1] for name in names)
        results = []
        for name, path in zip(names, found, strict=True):
            if path is not None:
                results.append(FoundFile(path))
                continue
            parents, stem, suffix = _parts(name)
            candidates = [one for one in self._photos.get(stem, ()) if one.path not in taken]
            best = _longest_matches(candidates, parents)
            # Photos of the same name are distinguished only by their folders.
            if best and parents and stems[stem] > 1 and _match(best[0], parents) == 0:
                best = []
            best = _with_suffix(best, suffix)
            results.append(_only(best, self._root))
        chosen = Counter(one.path for one in results if one.by_name)
        return [
            FoundFile(None, f"{chosen[one.path]} poses would use {one.path}; give each photo its own name")
            if one.by_name and chosen[one.path] > 1
            else one
            for one in results
        ]

    def find_mask(self, photo: Path, depth: int) -> FoundFile:
        """Find the mask of ``photo`` in a folder of masks, or beside it; ``depth`` is the number of parts of its name.

        The mask has the name of the photo, the name with .png appended (COLMAP), or the name with ``_mask`` appended.
        """
        depth = max(1, min(depth, len(photo.parents) - 1))
        for folder, parts in self._mask_folders(photo.parent, depth):
            file = Path(*photo.parts[-parts:])
            for path in (folder / f"{file}.png", (folder / file).with_suffix(".png"), folder / file):
                if os.path.isfile(path):
                    return FoundFile(path)
        if not self._masks:
            return FoundFile(None)
        inside = path_inside(photo, self._root)
        if inside is None:
            return FoundFile(None)
        parents = tuple(_key(part) for part in inside.parts[:-1])
        candidates = [
            one
            for one in self._masks.get(_mask_stem(photo.name), ())
            if one.path != photo and one.base == parents[: len(one.base)]
        ]
        best = _longest_matches(candidates, parents)
        # A mask in another folder could belong to another photo of the same name.
        if best and best[0].folders and _match(best[0], parents) == 0 and self._is_repeated(photo):
            best = []
        return _only(best, self._root)

    def find_named_mask(self, name: str, folder: Path) -> FoundFile:
        """Find the mask ``name``, which should be relative to ``folder``."""
        path = self._direct(name, (folder,))
        if path is not None:
            return FoundFile(path)
        parents, stem, suffix = _parts(name)
        best = _with_suffix(_longest_matches(self._pictures.get(stem, ()), parents), suffix)
        if best and parents and _match(best[0], parents) == 0:
            best = []
        found = _only(best, self._root)
        return found if found.path or found.reason else FoundFile(None, f"its mask {name} was not found; put it there")

    def _mask_folders(self, folder: Path, depth: int) -> list[tuple[Path, int]]:
        """Return the existing folders of masks for photos of ``folder``, each with the number of parts of the photo's
        path that are repeated in it."""
        if (folder, depth) not in self._known_mask_folders:
            places = [((folder, *folder.parents)[depth] / "masks", depth), (folder.parent / "masks", 1)]
            self._known_mask_folders[folder, depth] = [place for place in places if os.path.isdir(place[0])]
        return self._known_mask_folders[folder, depth]

    def _is_repeated(self, photo: Path) -> bool:
        """Return True if photos in several folders have the name of ``photo``."""
        return len({one.folders for one in self._photos.get(_picture_stem(photo.name), ())}) > 1

    def _direct(self, name: str, folders: Sequence[Path]) -> Path | None:
        """Return the file ``name`` in the first of ``folders`` that contains it, if it is inside the data set."""
        for text in dict.fromkeys((name, name.replace("\\", "/"))):
            stays = stays_inside(text)
            for folder in folders:
                # Skip missing folders quickly, because most of them are missing, and there may be many photos.
                if stays and not self._exists(folder):
                    continue
                path = os.path.join(folder, text)
                if not stays:
                    inside = path_inside(Path(path), self._root)
                    if inside is None:
                        continue
                    path = self._root / inside
                # For names that are too long or invalid, os.path returns False, but Path.is_file raises.
                for suffix in _ADDED_SUFFIXES:
                    if os.path.isfile(f"{path}{suffix}"):
                        return Path(f"{path}{suffix}")
        return None

    def _exists(self, folder: Path) -> bool:
        """Return True if ``folder`` existed when it was first looked up."""
        if folder not in self._known_folders:
            self._known_folders[folder] = os.path.isdir(folder)
        return self._known_folders[folder]

    @cached_property
    def _files(self) -> list[tuple[Path, tuple[str, ...]]]:
        """Pictures below the data set, with their folders in lower case."""
        return list(_walk(self._root))

    @cached_property
    def _pictures(self) -> dict[str, list[_Candidate]]:
        """Pictures of the data set, by their stems."""
        return self._by_stem(lambda _folders: True)

    @cached_property
    def _photos(self) -> dict[str, list[_Candidate]]:
        """Pictures that may be photos, by their stems."""
        return self._by_stem(lambda folders: not any(_is_no_photos(folder) for folder in folders))

    def _by_stem(self, is_wanted: Callable[[tuple[str, ...]], bool]) -> dict[str, list[_Candidate]]:
        files = defaultdict(list)
        for path, folders in self._files:
            if is_wanted(folders):
                suffix = path.suffix.lower()
                files[_picture_stem(path.name)].append(_Candidate(path, folders, suffix, self._rank(folders)))
        return files

    def _rank(self, folders: tuple[str, ...]) -> int:
        for number, name in enumerate(self._order):
            if name in folders:
                return number
        if not folders:
            return 100
        reduced = next((match for folder in folders if (match := _REDUCED.fullmatch(folder))), None)
        return 200 + int(reduced[1]) if reduced else 400

    @cached_property
    def _masks(self) -> dict[str, list[_Candidate]]:
        """Masks, by the stems of their photos."""
        files = defaultdict(list)
        for path, folders in self._files:
            if not (_MAY_BE_MASK.search(path.name) or any(_MAY_BE_MASK.search(folder) for folder in folders)):
                continue
            at = next((number for number, folder in enumerate(folders) if _MASK_FOLDER.fullmatch(folder)), None)
            if at is not None:
                rank = _MASK_FOLDERS.index(folders[at]) if folders[at] in _MASK_FOLDERS else len(_MASK_FOLDERS)
                # The folders above the folder of masks also distinguish masks: front/masks and back/masks.
                below = (*folders[:at], *folders[at + 1 :])
                candidate = _Candidate(path, below, path.suffix.lower(), rank, folders[:at])
                files[_mask_stem(path.name)].append(candidate)
            elif _mask_stem(path.name) != _picture_stem(path.name):
                candidate = _Candidate(path, folders, path.suffix.lower(), 100, folders)
                files[_mask_stem(path.name)].append(candidate)
        return files


def has_photos(folder: Path) -> bool:
    """Return True if ``folder`` contains pictures or a folder of photos."""
    try:
        content = list(folder.iterdir())
    except OSError:
        return False
    return any(
        (path.suffix.lower() in PICTURE_SUFFIXES and not path.name.startswith(".")) or path.name in _PHOTO_FOLDERS
        for path in content
    )


def without_masks(paths: Sequence[Path], root: Path) -> tuple[list[Path], dict[Path, int]]:
    """Return the pictures among ``paths`` that are photos, and the number of the others in each folder.

    Pictures are no photos if their folder below ``root`` has a name such as masks or depth, or if they lie beside a
    photo as its mask (00_mask.png). Pictures in a folder such as normals or alpha are no photos if each of them has the
    name of a photo elsewhere (00.png or 00_normal.png for 00.jpg). If no photo were left, all pictures are photos.
    """
    stems = {(path.parent, _picture_stem(path.name)) for path in paths}
    certain, doubtful = set(), defaultdict(set)
    for path in paths:
        folders = path.relative_to(root).parts[:-1]
        if any(_MAY_BE_NO_PHOTOS.fullmatch(folder) for folder in folders):
            doubtful[path.parent].add(_OWN_WORD.sub("", _picture_stem(path.name)))
        elif not any(_NO_PHOTOS.search(folder) for folder in folders):
            certain.add(_picture_stem(path.name))
    repeated = {folder for folder, names in doubtful.items() if names <= certain}

    def is_photo(path: Path) -> bool:
        folders = path.relative_to(root).parts[:-1]
        if path.parent in repeated or any(_NO_PHOTOS.search(folder) for folder in folders):
            return False
        stem = _mask_stem(path.name)
        return stem == _picture_stem(path.name) or (path.parent, stem) not in stems

    photos = [path for path in paths if is_photo(path)]
    if not photos:
        return list(paths), {}
    return photos, dict(Counter(path.parent for path in paths if not is_photo(path)))


def _is_no_photos(name: str) -> bool:
    """Return True if ``name`` is that of masks, depth images or the like."""
    return bool(_NO_PHOTOS.search(name) or _MAY_BE_NO_PHOTOS.fullmatch(name))


def photos_without_pose(images: Iterable[Path], excluded: Iterable[str] = ()) -> dict[Path, int]:
    """Return the number of photos without a pose in each folder of ``images`` that contains any. Photos with the names
    ``excluded``, whose poses are invalid, are not counted."""
    invalid = {_parts(name)[1] for name in excluded}
    posed = defaultdict(lambda: set(invalid))
    for image in images:
        posed[image.parent].add(_picture_stem(image.name))
    counts = {}
    for folder, stems in posed.items():
        others = {
            _picture_stem(path.name)
            for path in folder.iterdir()
            if path.suffix.lower() in PICTURE_SUFFIXES
            and not path.name.startswith(".")
            and not _is_no_photos(path.stem)
        }
        if others - stems:
            counts[folder] = len(others - stems)
    return counts


def _walk(root: Path) -> Iterator[tuple[Path, tuple[str, ...]]]:
    """Iterate over the pictures below ``root`` in a fixed order, without hidden folders."""
    seen, count = set(), 0
    for folder, folders, names in os.walk(root, followlinks=True):
        inside = Path(folder).relative_to(root).parts
        real = os.path.realpath(folder)
        if real in seen:
            folders.clear()
            continue
        seen.add(real)
        folders[:] = sorted(one for one in folders if not one.startswith(".")) if len(inside) < _MAX_DEPTH else []
        for name in sorted(names):
            count += 1
            if count > _MAX_FILES:
                return
            if os.path.splitext(name)[1].lower() in PICTURE_SUFFIXES and not name.startswith("."):
                yield Path(folder) / name, tuple(_key(part) for part in inside)


def _parts(name: str) -> tuple[tuple[str, ...], str, str]:
    """Return folders, stem and suffix of a path from any operating system, in lower case."""
    parts = [part for part in re.split(r"[\\/]+", _key(name)) if part not in ("", ".")]
    while ".." in parts:
        # At the beginning of the path, ``..`` is an unknown folder; elsewhere, it cancels the folder before it.
        at = parts.index("..")
        del parts[max(at - 1, 0) : at + 1]
    if parts and re.fullmatch(r"[a-z]:|file:", parts[0]):
        del parts[0]
    last = PurePath(parts[-1]) if parts else PurePath("")
    suffix = last.suffix if last.suffix in PICTURE_SUFFIXES else ""
    return tuple(parts[:-1]), last.name.removesuffix(suffix), suffix


def photo_stem(name: str) -> str:
    """Return the last part of a path from any operating system, without the suffix of a picture, in lower case."""
    return _parts(name)[1]


def _key(name: str) -> str:
    """Return ``name`` in lower case with composed letters, because operating systems store letters differently."""
    return unicodedata.normalize("NFC", name).lower()


def _picture_stem(name: str) -> str:
    stem, suffix = os.path.splitext(_key(name))
    return stem if suffix in PICTURE_SUFFIXES else _key(name)


def _mask_stem(name: str) -> str:
    """Return the stem of the photo to which the mask ``name`` belongs: 00.jpg.png, 00_mask.png and 00.png give 00."""
    *_, stem = _shortened(name, _MASK_SUFFIX)
    return stem


def stems_of_mask(name: str) -> Iterator[str]:
    """Iterate over the stems of the photos to which the mask ``name`` may belong, the longest first: 00_mask.jpg.png
    gives 00_mask.jpg, 00_mask and 00. All are in lower case, as those of ``photo_stem``."""
    return _shortened(photo_stem(name), _TOOL_SUFFIX)


def _shortened(name: str, suffix: re.Pattern[str]) -> Iterator[str]:
    """Iterate over ``name`` without the suffixes of pictures, ``_MASK_PREFIX`` and ``suffix``, which are removed one
    after the other."""
    stem, shorter = "", _key(name)
    while shorter != stem:
        stem = shorter
        yield stem
        shorter = _picture_stem(stem)
        if shorter == stem:
            match = _MASK_PREFIX.match(stem)
            shorter = stem[match.end() :] if match else suffix.sub("", stem)


def _match(candidate: _Candidate, parents: tuple[str, ...]) -> int:
    """Return the number of innermost folders that ``candidate`` and ``parents`` have in common."""
    count = 0
    for one, other in zip(reversed(candidate.folders), reversed(parents), strict=False):
        if one != other:
            break
        count += 1
    return count


def _longest_matches(candidates: Sequence[_Candidate], parents: tuple[str, ...]) -> list[_Candidate]:
    """Return the candidates that have the most innermost folders in common with ``parents``."""
    longest = max((_match(one, parents) for one in candidates), default=0)
    return [one for one in candidates if _match(one, parents) == longest]


def _with_suffix(candidates: list[_Candidate], suffix: str) -> list[_Candidate]:
    """Return the candidates that can be read, if there are any; among them those with ``suffix``, if there are any."""
    candidates = [one for one in candidates if one.suffix not in UNREADABLE_SUFFIXES] or candidates
    return [one for one in candidates if one.suffix == suffix] or candidates


def _only(candidates: list[_Candidate], root: Path) -> FoundFile:
    """Return the candidate with the best rank; no file if several candidates share this rank."""
    if not candidates:
        return FoundFile(None)
    best = min(one.rank for one in candidates)
    chosen = [one for one in candidates if one.rank == best]
    if len(chosen) > 1:
        names = " and ".join(os.path.relpath(one.path, root) for one in chosen[:2])
        return FoundFile(None, f"{len(chosen)} files fit its name, {names}; keep one, or give its folder in the poses")
    return FoundFile(chosen[0].path, by_name=True)
