"""Shared parts of all benchmarks: flags, the data folder, timing, the printed table, and the JSON and image output.

A benchmark takes ``--quick`` (under ten minutes on two cores), ``--device``, ``--seed``, ``--json PATH`` and ``--plot
PATH``. It prints a table and writes JSON with ``rows`` (the results), ``environment`` (device, versions and settings of
the measurement), ``aims`` (true or false, computed from the rows, or null if not measured) and ``why_null`` (the reason
for each null).
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import numpy as np
import warp as wp

from egs_warp.io.video import write_png
from egs_warp.launching import available_threads
from egs_warp.pipelines.many import map_tasks
from egs_warp.pipelines.report import MECHANICS, versions
from egs_warp.pipelines.worker_pool import ProgressCallback

if TYPE_CHECKING:
    from matplotlib.figure import Figure

P = ParamSpec("P")
T = TypeVar("T")
Row = dict[str, Any]
"""Record of a benchmark: values by name."""


def flags(
    description: str | None, *, quick: str, device: str | None = None, seed: str | None = None, plot: str | None = None
) -> argparse.ArgumentParser:
    """Create the parser with the flags that every benchmark takes.

    Args:
        description: the script's docstring.
        quick: help text of ``--quick``.
        device: default of ``--device``; None for the first GPU, or the CPU without one.
        seed: help text of ``--seed``.
        plot: help text of ``--plot``.
    """
    wp.config.log_level = wp.LOG_WARNING
    if device is None:
        device = "cuda:0" if wp.is_cuda_available() else "cpu"
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help=quick)
    parser.add_argument("--device", default=device, help=f"{device} by default")
    parser.add_argument("--seed", type=int, default=0, help=seed)
    parser.add_argument("--json", type=Path, help="JSON file for the result")
    parser.add_argument("--plot", type=Path, help=plot or "image file for the plot")
    return parser


def workers_flag(parser: argparse.ArgumentParser) -> None:
    """Add the flag ``--workers``, whose value is the argument ``workers`` of ``rows_of``."""
    parser.add_argument(
        "--workers",
        type=lambda text: int(text) if text.isdecimal() else text,
        help="processes, by default one for each core; ray, or the address of a Ray cluster",
    )


def rows_of(run: Callable[..., Row], tasks: Sequence[tuple[Any, ...]], workers: int | str | None) -> Iterator[Row]:
    """Call ``run`` with the arguments of each task in parallel and yield its rows as they are completed.

    A task whose process dies is repeated.

    Raises:
        RuntimeError: tasks failed; raised after all other tasks are completed.
    """
    failed = []
    for ended in map_tasks(_Run(run), tasks, workers=workers):
        if ended.error is None:
            yield ended.value
        else:
            failed.append(f"{tasks[ended.number]}: {ended.error}")
    if failed:
        raise RuntimeError("; ".join(failed))


@dataclass(frozen=True)
class _Run:
    run: Callable[..., Row]

    def __call__(self, task: tuple[Any, ...], progress: ProgressCallback) -> Row:
        return self.run(*task)


def data_folder() -> Path:
    """Return the folder of captures, meshes and points: $EGS_WARP_DATA, or the default folder next to the
    repository."""
    return Path(os.environ.get("EGS_WARP_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))


def timed(action: Callable[P, T], *arguments: P.args, **options: P.kwargs) -> tuple[T, float]:
    """Return the result of ``action`` and its duration in milliseconds."""
    started = time.perf_counter()
    result = action(*arguments, **options)
    return result, 1e3 * (time.perf_counter() - started)


def median_ms(
    calls: Mapping[str, Callable[[], Any]],
    *,
    repeats: int,
    synchronise: Callable[[], Any] = lambda: None,
    warm_up: int = 3,
) -> dict[str, float]:
    """Return the median time of each call in ms. The calls alternate, so that a drift of the machine's speed affects
    all of them equally."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(repeats + warm_up):
        for name, call in calls.items():
            synchronise()
            started = time.perf_counter()
            call()
            synchronise()
            if turn >= warm_up:
                times[name].append(1e3 * (time.perf_counter() - started))
    return {name: statistics.median(values) for name, values in times.items()}


class Table:
    """Text table with a header; each row is printed as soon as it is known."""

    def __init__(self, **columns: str) -> None:
        """Print the header. The keys are the names of the columns, in which ``_`` is printed as a space; the values are
        their formats, such as ``8.2f`` or ``<12``."""
        self._formats = list(columns.values())
        names = [name.replace("_", " ") for name in columns]
        self._widths = [
            max(len(name), len(self._cell(form, 0 if form[-1] in "defg%" else "")))
            for name, form in zip(names, self._formats, strict=True)
        ]
        self._line(names)

    def row(self, *values: Any) -> None:
        """Print one row; None is printed as a dash."""
        self._line([self._cell(form, value) for form, value in zip(self._formats, values, strict=True)])

    @staticmethod
    def _cell(form: str, value: Any) -> str:
        return "-" if value is None else format(value, form)

    def _line(self, cells: list[str]) -> None:
        aligned = (
            f"{cell.strip():<{width}}" if form.startswith("<") else f"{cell.strip():>{width}}"
            for cell, form, width in zip(cells, self._formats, self._widths, strict=True)
        )
        print("  ".join(aligned).rstrip(), flush=True)


def example(name: str) -> ModuleType:
    """Import a script of ``examples/``, which is not a package."""
    path = Path(__file__).resolve().parents[1] / "examples" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"example_{name}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def environment(options: argparse.Namespace, packages: Sequence[str] = ()) -> dict[str, Any]:
    """Return the device, versions and settings of the measurement, with the versions of ``packages``."""
    return {
        "device": options.device,
        "device_name": wp.get_device(options.device).name,
        "threads": available_threads(),
        **versions((*MECHANICS, *packages)),
        "quick": options.quick,
        "seed": options.seed,
    }


def record(
    options: argparse.Namespace,
    rows: Any,
    *,
    aims: Mapping[str, bool | None],
    why_null: Mapping[str, str] | None = None,
    packages: Sequence[str] = (),
    conditions: Mapping[str, Any] | None = None,
    **more: Any,
) -> dict[str, Any]:
    """Return the result as a dictionary and write it to the file of ``--json``, if given.

    Args:
        options: parsed flags of the benchmark.
        rows: records of the benchmark.
        aims: whether each aim is met; None if it was not measured.
        why_null: reason for each None.
        packages: packages whose versions are recorded.
        conditions: further entries of ``environment``, such as settings of the measurement.
        more: further entries of the result.

    Raises:
        ValueError: an aim is null without a reason.
    """
    why = dict(why_null or {})
    unexplained = [name for name, value in aims.items() if value is None and name not in why]
    if unexplained:
        raise ValueError(f"aims without a value need a reason in why_null: {', '.join(unexplained)}")
    result = {
        "rows": rows,
        **more,
        "environment": {**environment(options, packages), **(conditions or {})},
        "aims": {name: None if value is None else bool(value) for name, value in aims.items()},
        "why_null": why,
    }
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n")
    return result


def report(
    options: argparse.Namespace,
    rows: Any,
    *,
    draw: Callable[[Figure], None] | None = None,
    picture: np.ndarray | None = None,
    size: tuple[float, float] = (7.0, 3.5),
    **result: Any,
) -> None:
    """Write the final result: the JSON of ``record``, the aims as text, and the image for ``--plot``.

    Args:
        draw: function that draws into an empty figure of ``size`` inches.
        picture: (H, W, 3) image, uint8 or floats from 0 to 1, that is written in place of a drawing.
    """
    result_record = record(options, rows, **result)
    print(json.dumps({name: result_record[name] for name in ("aims", "why_null")}, indent=1))
    if options.plot and draw is not None:
        from matplotlib.figure import Figure

        figure = Figure(figsize=size, layout="tight")
        draw(figure)
        figure.savefig(options.plot, dpi=120)
    if options.plot and picture is not None:
        floats = picture.dtype != np.uint8
        write_png(options.plot, np.rint(255.0 * np.clip(picture, 0.0, 1.0)).astype(np.uint8) if floats else picture)
