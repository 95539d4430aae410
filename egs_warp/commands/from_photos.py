"""``egs-warp from-photos``: go from photos or a video to poses, capture, object and film with one command."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from egs_warp.commands.flags import Commands, add_out_flag
from egs_warp.commands.scene_flags import add_object_flags, print_above_bars, print_note
from egs_warp.errors import UserError
from egs_warp.installation import install_command

if TYPE_CHECKING:
    from egs_warp.io.stage_record import StageRecord, StageState
    from egs_warp.pipelines.progress import PhotosBar

EXAMPLES = (
    "photos --out out/toy",
    'walkaround.mp4 --motion "hop x3, twist 180" --yes --out out/toy',
    "posed --device cuda:0 --out out/toy",
    "room.ply --cameras posed --out out/toy",
)
_POSE, _TRAIN, _PICK, _FILM = "pose", "train", "pick", "film"
_POSED, _CAPTURE, _PICKED = "posed", "capture.ply", "picked.json"
"""Names in the output folder: posed photos, capture and picked object. The film has a folder named after its stage."""
_BARS = {_POSE: ("pose",), _TRAIN: ("train",), _PICK: ("pick",), _FILM: ("scene", "prepare", "simulate", "render")}
"""Stages of the progress bar that belong to each stage of the command."""
_TRAIN_FLAGS = ("iterations", "gaussians")
_PICK_FLAGS = ("up", "mask_model", "view")
_POSE_FILES = (".json", ".csv", ".xml")
"""Endings of files with camera poses; other files are videos or captures."""


def add_parser(commands: Commands) -> None:
    """Add the command to the subparsers ``commands``."""
    film = commands.add_parser("from-photos", help="photos or a video to a film: pose, train, pick, animate")
    film.add_argument(
        "photos", help="folder of photos, or a video; photos with poses, as for train; or a capture, as for animate"
    )
    add_out_flag(
        film,
        "folder for posed, capture.ply, picked.json and film; repeat the command to continue an interrupted run",
    )
    film.add_argument("--motion", default="jump", help="motion of the film, as for animate (jump)")
    film.add_argument("--yes", action="store_true", help="take the object that is found; open no page to pick it")
    film.add_argument("--iterations", type=int, help="optimiser steps of the training (cpu 1300, cuda 7000)")
    film.add_argument("--gaussians", type=int, help="maximum number of Gaussians (cpu 20000, cuda unlimited)")
    add_object_flags(film)
    film.add_argument("--up", help="axis that points up: x, y, z, -x, -y or -z, such as --up=-y (default: estimated)")
    film.add_argument("--preview", action="store_true", help="film with fewer pixels and Gaussians")
    film.add_argument("--device", default="cpu", help="cpu (default) or cuda:0")
    film.add_argument("--port", type=int, default=0, help="port of the page on 127.0.0.1 (default: any free port)")
    film.add_argument("--no-browser", action="store_true", help="print the address, but do not open the browser")
    film.set_defaults(run=_from_photos, parsers=commands.choices)


@dataclass(frozen=True)
class _Source:
    """Input of a run: photos, photos with poses, or a capture."""

    photos: Path | None
    posed: Path | None
    capture: Path | None

    @property
    def stages(self) -> tuple[str, ...]:
        """Stages that lead from this input to a film."""
        if self.photos is not None:
            return (_POSE, _TRAIN, _PICK, _FILM)
        return (_TRAIN, _PICK, _FILM) if self.capture is None else (_PICK, _FILM)


def _from_photos(args: argparse.Namespace) -> int:
    from egs_warp.io.atomic import lock, result_folder
    from egs_warp.io.stage_record import StageRecord
    from egs_warp.pipelines.progress import photos_bar

    source = _source(args)
    _check(args, source)
    with result_folder(args.out) as folder, lock(folder / ".egs-stages.lock") as acquired:
        if not acquired:
            raise UserError(f"{args.out}: another run is writing into this folder; wait for it, or choose another one")
        with (
            _kernels_for(args.device),
            photos_bar([bar for stage in source.stages for bar in _BARS[stage]]) as bar,
        ):
            run = _Run(args, folder, StageRecord(folder), bar)
            try:
                status = run.all_stages(source)
            except BaseException as error:
                # Only signals need this hint: the message of an error already says what to change.
                if not isinstance(error, Exception):
                    error.add_note("repeat the command to continue")
                raise
    print(f"egs-warp view {folder / _FILM} shows it in 3D")
    return status


def _kernels_for(device: str) -> AbstractContextManager[object]:
    """Context in which the kernels of later stages are compiled for a GPU while the first stages use it. On a CPU, all
    cores are busy with these stages."""
    from egs_warp.pipelines.machine import compiling_in_background

    return nullcontext() if device == "cpu" else compiling_in_background(device)


def _source(args: argparse.Namespace) -> _Source:
    """Return the input that the argument names. Raises ``UserError`` if it does not exist or does not match
    ``--cameras``."""
    from egs_warp.io.frames import VIDEO_SUFFIXES
    from egs_warp.io.pose_files import find_poses

    path = Path(args.photos)
    if not path.exists():
        raise UserError(f"{path}: no such file or folder; give photos, a video, photos with poses, or a capture")
    kind = "photos"
    if path.is_file():
        suffix = path.suffix.lower()
        kind = "photos" if suffix in VIDEO_SUFFIXES else "posed" if suffix in _POSE_FILES else "capture"
    else:
        try:
            find_poses(path)
            kind = "posed"
        except UserError:
            kind = "capture" if (path / "meta.json").is_file() else "photos"
    if kind == "capture":
        return _Source(None, args.cameras, path)
    if args.cameras is not None:
        raise UserError("--cameras: photos with poses already have cameras; leave it out, or give a capture")
    return _Source(path, None, None) if kind == "photos" else _Source(None, path, None)


def _check(args: argparse.Namespace, source: _Source) -> None:
    """Raise the ``UserError`` that a later stage would raise for the flags, before any long computation."""
    from egs_warp.commands.animate import animate_options
    from egs_warp.io import read_cameras
    from egs_warp.io.run_folder import check_out
    from egs_warp.io.stage_record import NAME
    from egs_warp.io.video import ffmpeg_program
    from egs_warp.training import has_torch
    from egs_warp.web.page import page_text
    from egs_warp.web.server import check_port

    check_out(args.out)
    if not (args.out / NAME).is_file():
        for name in (_POSED, _CAPTURE, _PICKED, _FILM):
            if (args.out / name).exists():
                raise UserError(f"--out {args.out}: it contains {name} from another command; choose another folder")
    if source.capture is None and args.out.absolute().is_relative_to(Path(args.photos).absolute()):
        raise UserError(f"--out {args.out}: it is in the folder of the photos; choose a folder beside it")
    ffmpeg_program()
    _film_arguments(args, Path(_CAPTURE), None, check=animate_options)
    if not args.yes:
        page_text()
        check_port(args.port)
    if source.posed is not None:
        read_cameras(source.posed)
    if source.capture is None and not has_torch():
        raise UserError(f"train: PyTorch is not installed; {install_command('torch')}")


def _film_arguments(
    args: argparse.Namespace,
    capture: Path,
    posed: Path | None,
    *,
    check: Callable[[argparse.Namespace], object] = lambda film: None,
) -> argparse.Namespace:
    """Return the flags of ``animate`` for the film, after ``check``."""
    words = [str(capture), f"--object={args.out / _PICKED}", f"--out={args.out / _FILM}", f"--motion={args.motion}"]
    words += [f"--device={args.device}", *(["--preview"] if args.preview else [])]
    film = args.parsers["animate"].parse_args([*words, *([] if posed is None else [f"--cameras={posed}"])])
    film.command = "animate"
    check(film)
    return film


class _Run:
    """Stages of one run of the command."""

    def __init__(self, args: argparse.Namespace, folder: Path, record: StageRecord, bar: PhotosBar) -> None:
        self._args, self._folder, self._record, self._bar = args, folder, record, bar

    def all_stages(self, source: _Source) -> int:
        """Run the stages that have not finished; return the exit status."""
        posed, capture = source.posed, source.capture
        if source.photos is not None:
            self._pose(source.photos)
            posed = self._folder / _POSED
        if capture is None:
            assert posed is not None
            self._train(posed)
            capture = self._folder / _CAPTURE
        self._pick(capture, posed)
        return self._film(capture, posed)

    @contextmanager
    def _stage(
        self, stage: str, options: Mapping[str, Any], inputs: Sequence[Path], files: Callable[[], Sequence[Path]]
    ) -> Iterator[StageState | None]:
        """Context of one stage: yield the state of ``stage``, or None if it has already finished. The start of the
        stage is recorded, and at its end, the ``files`` that it has written."""
        from egs_warp.io.stage_record import StageState, stage_key

        self._bar.update(_BARS[stage][0])
        key = stage_key(options, inputs)
        state = self._record.state(stage, key)
        if state is StageState.FINISHED:
            self._bar.skip(*_BARS[stage])
            print_note(f"{stage}: already finished; its result is used")
            yield None
            return
        if state is StageState.OTHER:
            print_note(f"{stage}: its input, its flags or its files have changed; the stage runs again")
        self._record.begin(stage, key)
        yield state
        self._record.finish(stage, key, files())

    def _pose(self, photos: Path) -> None:
        from egs_warp.io.stage_record import StageState, files_below
        from egs_warp.pipelines.pose_photos import pose_photos

        posed = self._folder / _POSED
        files = lambda: [file for part in ("images", "sparse") for file in files_below(posed / part)]  # noqa: E731
        shares = {"features": (0.0, 0.2), "matches": (0.2, 0.4), "poses": (0.6, 0.4)}

        def progress(part: str, done: int, total: int) -> None:
            begin, share = shares[part]
            self._bar.update(_POSE, begin + share * done / max(total, 1))

        with self._stage(_POSE, {}, [photos], files) as state:
            if state is None:
                return
            result = pose_photos(
                photos, posed, overwrite=True, resume=state is StageState.INTERRUPTED, progress=progress
            )
            for reason in result.unreadable:
                print_note(f"left out {reason}")
            print_above_bars("\n".join(result.summary()))

    def _train(self, posed: Path) -> None:
        from egs_warp.commands.train import run_train
        from egs_warp.io.cameras import read_posed_images
        from egs_warp.io.stage_record import StageState

        args, capture = self._args, self._folder / _CAPTURE
        words = [f"--{name}={getattr(args, name)}" for name in _TRAIN_FLAGS if getattr(args, name) is not None]
        words += [str(posed), f"--out={capture}", f"--device={args.device}"]
        train = args.parsers["train"].parse_args(words)
        poses = read_posed_images(posed)
        photos = [path for one in poses.images for path in (one.image, one.mask) if path is not None]
        options = {name: getattr(args, name) for name in (*_TRAIN_FLAGS, "device")}
        with self._stage(_TRAIN, options, [poses.source, *photos], lambda: [capture]) as state:
            if state is None:
                return
            train.resume = state is StageState.INTERRUPTED and capture.with_suffix(".training.npz").is_file()
            train.overwrite = True
            lines = run_train(
                train,
                say=lambda text: print_note(text) if text.startswith("left out") else None,
                show_step=lambda step: self._bar.update(_TRAIN, step.done / step.iterations),
            )
            print_above_bars("\n".join(lines))

    def _pick(self, capture: Path, posed: Path | None) -> None:
        from egs_warp.commands.pick import pick_automatically, pick_on_page
        from egs_warp.io.run_folder import back_up
        from egs_warp.io.stage_record import StageState

        args, picked = self._args, self._folder / _PICKED
        words = [str(capture), f"--out={picked}", f"--device={args.device}", f"--port={args.port}"]
        words += [f"--{name.replace('_', '-')}={value}" for name in _PICK_FLAGS if (value := getattr(args, name))]
        words += [*(f"--object={value}" for value in args.object or ()), *(["--no-browser"] if args.no_browser else [])]
        pick = args.parsers["pick"].parse_args([*words, *([] if posed is None else [f"--cameras={posed}"])])
        options = {name: str(getattr(args, name)) for name in (*_PICK_FLAGS, "object")}
        # The user may correct the file later. Therefore it is recorded as an input of the film, not as an output here.
        with self._stage(_PICK, options, [capture], list) as state:
            if state is None and picked.is_file():
                return
            if state is not StageState.INTERRUPTED:
                back_up(self._folder, [_PICKED])
            # An interrupted run may have written the file with the object that the user has picked.
            if args.yes and not picked.is_file():
                pick_automatically(pick)
            elif args.yes:
                print_note(f"using the object of {picked}")
            elif not pick_on_page(pick, film=args.motion):
                raise UserError(f"{picked}: the page was stopped before Animate was pressed; repeat the command")

    def _film(self, capture: Path, posed: Path | None) -> int:
        from egs_warp.commands.animate import run_animate
        from egs_warp.commands.resume import status_of_finished
        from egs_warp.io.run_folder import has_finished
        from egs_warp.io.stage_record import StageState, files_below

        args, film = self._args, self._folder / _FILM
        animate = _film_arguments(args, capture, posed)
        options = {name: getattr(args, name) for name in ("motion", "preview", "device")}
        files = lambda: [one for one in files_below(film) if not _is_earlier(one.relative_to(film))]  # noqa: E731
        with self._stage(_FILM, options, [capture, self._folder / _PICKED], files) as state:
            if state is None:
                return status_of_finished(film)
            if state is StageState.INTERRUPTED:
                # A run of another version cannot be resumed; it is repeated from the start.
                with suppress(UserError):
                    if has_finished(film):
                        return status_of_finished(film)
                    animate.resume = True
            animate.overwrite = not animate.resume
            return run_animate(animate)


def _is_earlier(path: Path) -> bool:
    """Return True if ``path``, relative to the folder of a run, belongs to an earlier run that was moved aside."""
    return path.parts[0].startswith("earlier-")
