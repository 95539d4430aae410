"""Speed and image difference of the renderer: against gsplat and gswarp on a GPU, against plain PyTorch on a CPU.

Aims: ``cuda_beats_gswarp`` (faster in every cell), ``cuda_within_1_3_of_gsplat`` (geometric mean of all cells),
``ahead_of_gsplat_every_cell`` (faster than the faster of gsplat's packed and unpacked modes), ``same_picture`` (mean
difference below 1e-5, and below 1e-3 away from the alpha-cut boundaries), ``same_in_every_mode`` (the same for
antialiased images, for mean depth, with masked tiles, and with three cameras with a background each), ``cpu_vs_twin``
(20 times as fast as a tile-batched PyTorch rasteriser with the same culling), ``cpu_two_threads`` (two threads 1.7
times as fast as one), ``cpu_render_2x`` (twice as fast as commit f1c9b54, whose checkout ``--old`` names, with and
without gradients, with one thread and with two).

No other renderer that claims CPU support runs on a CPU: ``render_peers.cpu_baselines`` tries them and records why.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import warp as wp

import render_peers as peers
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import ARRAYS, GaussianCloud
from egs_warp.launching import available_threads
from egs_warp.render import render_gaussians
from egs_warp.render.compositing import Background, composite
from egs_warp.render.projection import project, view_from_camera
from egs_warp.render.tiles import build_tile_lists
from harness import Row, Table, data_folder, flags, median_ms, report, timed
from render_modes import difference, mode_row
from render_roofline import arithmetic_by_threads, stage_rows
from render_versions import compare_versions

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CELLS = ((1, 648, 420), (1, 1944, 1260), (5, 648, 420), (5, 1944, 1260), (11, 648, 420))
BASELINES: dict[str, Callable[[], peers.Renderer]] = {
    "gsplat": lambda: peers.gsplat_renderer(packed=True),
    "gsplat_unpacked": lambda: peers.gsplat_renderer(packed=False),
    "gswarp": peers.gswarp_renderer,
}
AIMS = (
    *("cuda_beats_gswarp", "cuda_within_1_3_of_gsplat", "ahead_of_gsplat_every_cell"),
    *("same_picture", "same_in_every_mode", "cpu_vs_twin", "cpu_two_threads", "cpu_render_2x"),
)


def cuda_rows(
    points: dict[str, np.ndarray], *, cells: tuple, seed: int, repeats: int, table: Table, others: Sequence[str]
) -> list[Row]:
    """Return one row per cell: times of the forward pass alone, and with the backward pass, for our renderer and for
    the installed renderers among ``others``."""
    renderers: dict[str, peers.Renderer] = {"ours": peers.ours}
    for name in others:
        try:
            renderers[name] = BASELINES[name]()
        except ImportError as error:
            print(f"{name} is not installed: {error}")
    rows = []
    for grid, width, height in cells:
        plain = peers.garden_scene(points, grid=grid, seed=seed, device="cuda")
        own = peers.ours_scene(plain)
        camera = peers.garden_camera(points, width=width, height=height)
        scenes = {name: own if name == "ours" else plain for name in renderers}
        weight = torch.rand((height, width, 3), device="cuda")

        def forward(name: str, scenes: dict = scenes, camera: Camera = camera) -> torch.Tensor:
            with torch.no_grad():
                return renderers[name](scenes[name], camera)

        def both(name: str, scenes: dict = scenes, camera: Camera = camera, weight: torch.Tensor = weight) -> None:
            for tensor in vars(scenes[name]).values():
                tensor.grad = None
            renderers[name](scenes[name], camera).backward(weight)

        row: Row = {"kind": "cuda", "gaussians": len(plain.means), "width": width, "height": height}
        for label, call in (("forward", forward), ("forward_backward", both)):
            calls = {name: (lambda call=call, name=name: call(name)) for name in renderers}
            row[label] = median_ms(calls, repeats=repeats, synchronise=torch.cuda.synchronize)
        # gswarp cuts splats off at three sigma and limits alpha to 0.99, which has no effect for opacities up to 0.35.
        fainter = replace(plain, opacities=plain.opacities.detach() * 0.35)
        faint = {name: peers.ours_scene(fainter) if name == "ours" else fainter for name in renderers}
        with torch.no_grad():
            pictures = {name: draw(faint[name], camera) for name, draw in renderers.items()}
        row["difference"] = {
            name: difference(pictures["ours"], picture) for name, picture in pictures.items() if name != "ours"
        }
        # These gradients are measured last, because the other renderers share leaf tensors and overwrite their
        # gradients.
        for name in ("ours", "gsplat"):
            if name in renderers:
                both(name)
        row["gradient_difference"] = _gradient_differences(scenes)
        row["stages"] = stage_rows(peers.cloud_of(own), camera, repeats=repeats, threads=1)
        rows.append(row)
        for label in ("forward", "forward_backward"):
            for name, ms in row[label].items():
                table.row(row["gaussians"], f"{width}x{height}", label, name, ms)
        torch.cuda.empty_cache()
    return rows


def _gradient_differences(scenes: dict[str, peers.Scene]) -> dict[str, float]:
    """Return the relative L2 difference from gsplat's gradients, after the chain rule to the parameters of captures."""
    if "gsplat" not in scenes:
        return {}
    own, other = scenes["ours"], scenes["gsplat"]
    opacity = other.opacities.detach()
    mine, theirs = ({name: t.grad for name, t in vars(scene).items() if t.grad is not None} for scene in (own, other))
    pairs = {
        "means": (mine["means"], theirs["means"]),
        "log_scales": (mine["scales"], theirs["scales"] * other.scales.detach()),
        "opacity_logits": (mine["opacities"], theirs["opacities"] * opacity * (1 - opacity)),
        # Our renderer clamps colours to 0, where the gradient is then zero; gsplat does not clamp its input colours.
        "sh": (mine["colours"][:, 0], theirs["colours"] * peers.SH_BAND_0 * (mine["colours"][:, 0] != 0)),
    }
    return {name: float((one - two).norm() / two.norm()) for name, (one, two) in pairs.items()}


def memory_row(*, seed: int) -> Row:
    """Measure the peak GPU memory of one 1920 x 1080 image of five million Gaussians with SH of degree 3, including the
    capture."""
    device, count = wp.get_device("cuda:0"), 5_000_000
    random = torch.Generator(device="cuda").manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(shape, generator=random, device="cuda") * 2 - 1

    cloud = GaussianCloud(
        means=wp.from_torch(uniform(count, 3), dtype=wp.vec3),
        rotations=wp.from_torch(uniform(count, 4), dtype=wp.vec4),
        log_scales=wp.from_torch(uniform(count, 3) - 6.0, dtype=wp.vec3),
        opacity_logits=wp.from_torch(uniform(count), dtype=wp.float32),
        sh=wp.from_torch(uniform(count, 16, 3), dtype=wp.vec3),
    )
    camera = Camera.look_at(np.array([0.0, -1.0, -3.0]), np.zeros(3), np.array([0, -1.0, 0]), width=1920, height=1080)
    before = wp.get_mempool_used_mem_current(device)
    picture = render_gaussians(cloud, camera)
    peak = wp.get_mempool_used_mem_high(device) - before
    capture = sum(getattr(cloud, name).capacity for name in ARRAYS)
    return {
        "kind": "memory",
        "gaussians": count,
        "width": 1920,
        "height": 1080,
        "capture_gib": capture / 2**30,
        "working_gib": peak / 2**30,
        "mean_alpha": float(wp.to_torch(picture.alpha).mean()),
    }


def cpu_row(points: dict[str, np.ndarray], *, seed: int, repeats: int, old: Path | None) -> Row:
    """Time 112k Gaussians at 640 x 480: one thread, two threads, plain PyTorch on the same tile lists, and the checkout
    ``old`` if given."""
    scene = peers.ours_scene(peers.garden_scene(points, grid=1, seed=seed, device="cpu"))
    camera = peers.garden_camera(points, width=640, height=480)
    cloud, view = peers.cloud_of(scene), view_from_camera(camera)
    threads = available_threads()
    torch.set_flush_denormal(True)
    probe = wp.zeros(16_384, dtype=wp.float32, device="cpu")
    projected = project(cloud, view, antialiased=False, threads=threads)
    lists = build_tile_lists(projected, view, threads=threads)
    times = median_ms(
        {
            "one_thread": lambda: render_gaussians(cloud, camera, background=(0, 0, 0), threads=1),
            "two_threads": lambda: render_gaussians(cloud, camera, background=(0, 0, 0), threads=2),
            "all_threads": lambda: render_gaussians(cloud, camera, background=(0, 0, 0), threads=threads),
            "arithmetic_one_thread": lambda: arithmetic_by_threads(1, probe),
            "arithmetic_two_threads": lambda: arithmetic_by_threads(2, probe),
        },
        repeats=repeats,
    )
    background = Background(wp.vec3())
    stages = {
        "project": lambda count: project(cloud, view, antialiased=False, threads=count),
        "lists": lambda count: build_tile_lists(projected, view, threads=count),
        "composite": lambda count: composite(projected, lists, view, background=background, threads=count),
    }
    by_stage = median_ms(
        {
            f"{name} {count}": lambda stage=stage, count=count: stage(count)
            for name, stage in stages.items()
            for count in sorted({1, 2, threads})
        },
        repeats=repeats,
    )
    project_and_list = by_stage[f"project {threads}"] + by_stage[f"lists {threads}"]
    twin_times: dict[int, float] = {}
    twin = torch.empty(0)
    # The faster of both thread counts is used, because on a busy machine PyTorch's threads block one another at every
    # operation.
    with torch.no_grad():
        for count in sorted({1, threads}):
            torch.set_num_threads(count)
            twin, twin_times[count] = timed(peers.composite_in_torch, projected, lists, camera)
    picture = wp.to_torch(render_gaussians(cloud, camera, background=(0, 0, 0), threads=threads).colour)
    return {
        "kind": "cpu",
        "peers": peers.cpu_baselines(scene, camera),
        "gaussians": cloud.count,
        "pairs": projected.slot_count,
        "width": 640,
        "height": 480,
        "threads": threads,
        **times,
        "stages_by_threads": by_stage,
        "stages": stage_rows(cloud, camera, repeats=repeats, threads=1),
        "twin": project_and_list + min(twin_times.values()),
        "difference": difference(picture, twin),
        "versions": compare_versions(cloud, camera, old=old, repeats=repeats) if old else None,
    }


def judge(rows: list[Row]) -> tuple[dict[str, bool | None], dict[str, str]]:
    """Return the aims, computed from the rows alone, and a reason for each aim that is None because this run could not
    measure it."""
    aims: dict[str, bool | None] = dict.fromkeys(AIMS)
    why: dict[str, str] = {}
    cuda = [row for row in rows if row["kind"] == "cuda"]
    labels = ("forward", "forward_backward")
    for aim, baseline in (("cuda_beats_gswarp", "gswarp"), ("cuda_within_1_3_of_gsplat", "gsplat")):
        if not cuda or any(baseline not in row["forward"] for row in cuda):
            why[aim] = "no CUDA device" if not cuda else f"{baseline} is not installed, or was left out"
            continue
        ratios = [row[label]["ours"] / _best(row[label], baseline) for row in cuda for label in labels]
        aims[aim] = max(ratios) < 1.0 if baseline == "gswarp" else float(np.exp(np.mean(np.log(ratios)))) <= 1.3
        if baseline == "gsplat":
            aims["ahead_of_gsplat_every_cell"] = max(ratios) < 1.0
    if aims["ahead_of_gsplat_every_cell"] is None:
        why["ahead_of_gsplat_every_cell"] = why["cuda_within_1_3_of_gsplat"]
    modes = [row for row in rows if row["kind"] == "modes"]
    if not modes:
        why["same_in_every_mode"] = "measured against gsplat on a GPU"
    for row in modes:
        aims["same_in_every_mode"] = all(_same(d) for d in row["difference"].values())
    differences = [d for row in cuda for d in row["difference"].values()] + [
        row["difference"] for row in rows if row["kind"] == "cpu"
    ]
    if differences:
        aims["same_picture"] = all(map(_same, differences))
    else:
        why["same_picture"] = "no other renderer is installed"
    cpu = [row for row in rows if row["kind"] == "cpu"]
    if not cpu:
        why |= dict.fromkeys(("cpu_vs_twin", "cpu_two_threads", "cpu_render_2x"), "measured with --device cpu")
    for row in cpu:
        aims["cpu_vs_twin"] = row["twin"] / row["all_threads"] >= 20.0
        reached = row["one_thread"] / row["two_threads"] >= 1.7
        machine = row["arithmetic_one_thread"] / row["arithmetic_two_threads"]
        twice = all(times["speedup"] >= 2.0 for times in (row["versions"] or {}).values())
        if not row["versions"]:
            why["cpu_render_2x"] = "measured with --old"
        elif twice or machine >= 1.8:
            aims["cpu_render_2x"] = twice
        else:
            ratios = [times["processor_speedup"] for times in row["versions"].values()]
            why["cpu_render_2x"] = f"the cores are busy; in processor time, at least {min(ratios):.2f} times as fast"
        if row["threads"] < 2:
            why["cpu_two_threads"] = "this machine has one core"
        elif reached or machine >= 1.8:
            aims["cpu_two_threads"] = reached
        else:
            why["cpu_two_threads"] = (
                f"in the same run this machine's two threads did plain arithmetic only {machine:.2f} times as fast as"
                " one: its cores are busy or are halves of one core"
            )
    return aims, why


def _same(off: dict[str, float]) -> bool:
    """Return True if two images are equal up to rounding.

    Rounding may decide whether a splat at its alpha cut, which contributes at most 1/255, is drawn. Therefore fewer
    than one value in a thousand may differ by more than 1e-3, and no value may differ by the contribution of two such
    splats.
    """
    return off["mean"] < 1e-5 and off["above_1e-3"] < 1e-3 and off["largest"] < 2 / 255


def _best(times: dict[str, float], baseline: str) -> float:
    """Return the milliseconds of the fastest variant of the renderer ``baseline``."""
    return min(ms for name, ms in times.items() if name.startswith(baseline))


def draw(figure: Figure, rows: list[Row]) -> None:
    """Draw milliseconds by cell and renderer and, on a GPU, the fraction of the device's limit that each stage
    reaches."""
    bars: list[tuple[str, dict[str, float]]] = []
    for row in rows:
        size = f"{row['gaussians'] / 1e3:.0f}k\n{row['width']}x{row['height']}"
        if row["kind"] == "cuda":
            bars += [(f"{size}\n{label}", row[label]) for label in ("forward", "forward_backward")]
        elif row["kind"] == "cpu":
            bars.append((f"{size}\nCPU", {k: row[k] for k in ("one_thread", "two_threads", "twin")}))
    roofs = [row for row in rows if "stages" in row]
    figure.set_size_inches(max(6.0, 1.6 * len(bars)), 9.0 if roofs else 5.0)
    panels = figure.subplots(1 + bool(roofs), squeeze=False)
    axes = panels[0, 0]
    names = sorted({name for _, values in bars for name in values})
    for index, name in enumerate(names):
        x = [i + (index - len(names) / 2) * 0.8 / len(names) for i, (_, v) in enumerate(bars) if name in v]
        axes.bar(x, [v[name] for _, v in bars if name in v], 0.8 / len(names), label=name, align="edge")
    axes.set_xticks(range(len(bars)), [label for label, _ in bars], fontsize=7)
    axes.set_yscale("log")
    axes.set_ylabel("ms")
    axes.legend()
    if roofs:
        plot_roofline(roofs, panels[1, 0])


def plot_roofline(rows: list[Row], axes: Any) -> None:
    """Draw the percentage of the device's limit that each stage reaches, for each combination of cloud and image size.
    The letter b means that bandwidth is the limit, a that arithmetic is."""
    names = ("project", "lists", "composite", "backward")
    for index, name in enumerate(names):
        stages = [row["stages"][name] for row in rows]
        bars = axes.bar(
            [i + (index - 2) * 0.2 for i in range(len(rows))],
            [100 * stage["share_of_limit"] for stage in stages],
            0.2,
            label=name,
            align="edge",
        )
        axes.bar_label(bars, [f"{stage['limit'][0]}\n{stage['ms']:.2f} ms" for stage in stages], fontsize=6)
    labels = [f"{row['gaussians'] / 1e3:.0f}k\n{row['width']}x{row['height']}" for row in rows]
    axes.set_xticks(range(len(rows)), labels, fontsize=7)
    axes.set_ylabel("% of the limit (b: bandwidth, a: arithmetic)")
    axes.margins(y=0.15)
    axes.legend()


def against_gsplat(rows: list[Row]) -> Row | None:
    """Return the ratio of our time to gsplat's in every cell, and a summary; None if gsplat is not installed."""
    ratios = {
        f"{row['gaussians']} {row['width']}x{row['height']} {label}": row[label]["ours"] / _best(row[label], "gsplat")
        for row in rows
        for label in ("forward", "forward_backward")
        if row["kind"] == "cuda" and "gsplat" in row[label]
    }
    if not ratios:
        return None
    return {
        "time_over_gsplats": ratios,
        "geometric_mean": float(np.exp(np.mean(np.log(list(ratios.values()))))),
        "cells_faster": sum(ratio < 1.0 for ratio in ratios.values()),
        "cells": len(ratios),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = flags(__doc__, quick="four cells in place of five on a GPU, fewer repeats")
    parser.add_argument(
        "--beside",
        nargs="+",
        choices=list(BASELINES),
        default=list(BASELINES),
        help="other renderers to time on a GPU (default all)",
    )
    parser.add_argument("--old", type=Path, help="checkout of commit f1c9b54, to be timed on a CPU")
    options = parser.parse_args(arguments)
    with np.load(data_folder() / "points" / "garden.npz") as arrays:
        points = dict(arrays)
    repeats = 10 if options.quick else 30
    rows: list[Row] = []
    table = Table(gaussians="9d", size="9s", what="<16", renderer="<12", ms="9.3f")
    if options.device.startswith("cuda"):
        cells = CELLS[:4] if options.quick else CELLS
        # The memory is measured first, because the memory pool records only the peak since the process started.
        rows.append(memory_row(seed=options.seed))
        rows += cuda_rows(points, cells=cells, seed=options.seed, repeats=repeats, table=table, others=options.beside)
        if "gsplat" in rows[-1]["forward"]:
            rows.append(mode_row(points, seed=options.seed, repeats=repeats))
            for name, off in rows[-1]["difference"].items():
                print(f"{name}: {off['mean']:.1e} mean difference from gsplat's image, {off['largest']:.1e} at most")
            for name, ms in rows[-1]["three_cameras"].items():
                table.row(rows[-1]["gaussians"], f"{rows[-1]['width']}x{rows[-1]['height']}", "three cameras", name, ms)
        print(f"working memory of five million Gaussians: {rows[0]['working_gib']:.2f} GiB")
    else:
        row = cpu_row(
            points, seed=options.seed, repeats=5 if options.quick else 15, old=options.old and options.old.resolve()
        )
        rows.append(row)
        for name in ("one_thread", "two_threads", "all_threads", "twin"):
            table.row(row["gaussians"], f"{row['width']}x{row['height']}", "cpu", name, row[name])
        for name, times in (row["versions"] or {}).items():
            print(
                f"{name} threads: {times['old_ms']:.1f} -> {times['new_ms']:.1f} ms,"
                f" {times['speedup']:.2f} times as fast ({times['processor_speedup']:.2f} in processor time)"
            )
        for name, baseline in row["peers"].items():
            print(f"{name}: {baseline['ms'] or baseline['outcome']}")
    aims, why_null = judge(rows)
    ratios = against_gsplat(rows)
    if ratios is not None:
        print(
            f"time relative to gsplat: {ratios['geometric_mean']:.2f} (geometric mean), faster in"
            f" {ratios['cells_faster']}"
        )
    report(
        options,
        rows,
        against_gsplat=ratios,
        aims=aims,
        why_null=why_null,
        packages=["torch"],
        draw=lambda figure: draw(figure, rows),
    )


if __name__ == "__main__":
    main()
