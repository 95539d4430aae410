"""Weights of the energy of clicks in photos, fitted on procedural rooms, and their score on other rooms.

The rooms are those of ``room_scenes.py`` with seeds that no other benchmark uses. The weights of links and supervoxels
are fitted by logistic regression: links against the boundary of the labelled object, supervoxels against its label for
one click in each of two annotated photos. The weight of a background supervoxel decays with its distance from the
click.
``score`` is the overlap (IoU) of the selected supervoxels with the object, weighted by their blending weight in the
judged photos, after the first click and after corrections, each of which is in the middle of the largest wrong part.
``rim`` is the mean overlap after the first click and one click beside the object, on a random place of its rim.
The weights ``smoothness``, ``correction``, ``crossing`` and ``barrier`` were chosen by the first three scores, one at a
time, on the fitted rooms; the weight of colours and the sizes of their cells on the rooms of seeds 101 to 104; the
variance by all four scores, on rooms of seeds 51 to 54.

With ``--fit``, weights are fitted and printed; without, those of the package are scored. There are no aims.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from clicking import CLICKED, JUDGED, innermost
from egs_warp.geometry.plane import Plane
from egs_warp.segmentation.click_energy import (
    WEIGHTS,
    ClickScene,
    EnergyWeights,
    Observation,
    consistent,
    minimise,
    picture_scale,
)
from egs_warp.segmentation.clicks import Click, click_at
from egs_warp.segmentation.graph_cut import SplatGraph
from egs_warp.segmentation.surface_graph import SurfaceGraph
from egs_warp.segmentation.votes import MaskedView, blending_votes
from harness import Row, Table, flags, report
from room_scenes import SCENES, build_scene

DECAY = 0.2
"""Surface distance, in image radii, over which the weight of background supervoxels decays."""
MIN_ERROR, HITS = 0.01, 5
"""Minimum size of a wrong part that is clicked, as a fraction of the object, and number of supervoxels that a click
hits."""
RIM_CLICKS = 3
"""Number of clicks on the rim, one at a time."""


@dataclass(frozen=True)
class LabelledScene:
    """A room prepared for clicks."""

    name: str
    surface: SurfaceGraph
    ground: Plane
    is_own: np.ndarray
    """(m,) bool, opaque Gaussians of the object."""
    truth: np.ndarray
    """(k,) bool, supervoxels of the object."""
    visible: np.ndarray
    """(k,) blending weight in the judged photos."""
    clicks: tuple[Click, ...]

    @classmethod
    def of(cls, name: str, seed: int, density: float) -> LabelledScene:
        """Build the room ``name`` of ``SCENES`` with its labels."""
        scene = build_scene(name, seed=seed, density=density, device="cpu")
        surface = SurfaceGraph.of(scene.cloud, scene.cameras)
        up = scene.frame.axes[2]
        views = [MaskedView(one.camera, np.ones(one.mask.shape, bool)) for one in scene.drawn.views[JUDGED]]
        weight = blending_votes(scene.cloud, views).inside[surface.nodes]
        own = scene.is_object[surface.nodes]
        hits = [click_at(scene.cloud, one.camera, *innermost(one.mask)[1]) for one in scene.drawn.views[CLICKED][:2]]
        return cls(
            name,
            surface,
            Plane(up, -float(up @ scene.frame.origin)),
            own,
            surface.per_cluster(own.astype(np.float64)) > 0.5,
            np.bincount(surface.own, weight, surface.count),
            tuple(hit for hit in hits if hit is not None),
        )

    def iou(self, chosen: np.ndarray) -> float:
        """Return the overlap of the ``chosen`` (k,) bool supervoxels with the object."""
        union = float(self.visible[chosen | self.truth].sum())
        return float(self.visible[chosen & self.truth].sum()) / max(union, 1e-30)


def regression(features: np.ndarray, labels: np.ndarray, weights: np.ndarray) -> tuple[tuple[float, ...], float]:
    """Return the coefficients and the bias of a logistic regression of ``labels`` (n,) bool."""
    mean, spread = features.mean(axis=0), features.std(axis=0) + 1e-9
    columns = np.column_stack([(features - mean) / spread, np.ones(len(features))])
    weights = weights / weights.sum()

    def loss(values: np.ndarray) -> tuple[float, np.ndarray]:
        logits = columns @ values
        slope = columns.T @ (weights * (1.0 / (1.0 + np.exp(-logits)) - labels))
        slope[:-1] += 2e-4 * values[:-1]
        return float(weights @ (np.logaddexp(0.0, logits) - labels * logits) + 1e-4 * (values[:-1] ** 2).sum()), slope

    best = minimize(loss, np.zeros(columns.shape[1]), jac=True, method="L-BFGS-B").x
    slopes = best[:-1] / spread
    return tuple(float(one) for one in slopes), float(best[-1] - slopes @ mean)


def click_scene(labelled: LabelledScene, click: Click, weights: EnergyWeights) -> ClickScene:
    """Return the terms of the energy that are the same for all clicks, for the object at the first ``click``."""
    scale = picture_scale(click.point, labelled.surface.cameras)
    return ClickScene.of(labelled.surface, labelled.ground, scale, weights=weights)


def fitted(scenes: Sequence[LabelledScene]) -> EnergyWeights:
    """Return the package's weights with links and supervoxels fitted to ``scenes``."""
    boundary = []
    for labelled in scenes:
        links = labelled.surface.links
        boundary.append(labelled.is_own[links.first] != labelled.is_own[links.second])
    labels = np.concatenate(boundary).astype(np.float64)
    slopes, link_bias = regression(
        np.concatenate([labelled.surface.features.matrix() for labelled in scenes]), labels, np.ones(len(labels))
    )
    weights = replace(WEIGHTS, links=slopes, link_bias=link_bias)
    features, labels, importance = [], [], []
    for labelled in scenes:
        for click in labelled.clicks:
            scene = click_scene(labelled, click, weights)
            evidence = scene.evidence([(np.unique(labelled.surface.cluster[click.hits]), True)], weights=weights)
            own = scene.area * labelled.truth
            other = scene.area * ~labelled.truth * np.exp(-np.exp(evidence.features[:, 0]) / DECAY)
            features.append(evidence.features)
            labels.append(labelled.truth)
            importance.append(own / own.sum() + other / other.sum())
    nodes, node_bias = regression(np.concatenate(features), np.concatenate(labels), np.concatenate(importance))
    return replace(weights, nodes=nodes, node_bias=node_bias)


def correction(labelled: LabelledScene, links: SplatGraph, chosen: np.ndarray) -> tuple[np.ndarray, bool] | None:
    """Return the supervoxels that a click in the middle of the largest wrong part hits, and whether they are the
    object's; None if no part is large enough."""
    wrong = chosen != labelled.truth
    same = wrong[links.first] & wrong[links.second] & (chosen[links.first] == chosen[links.second])
    pairs = (links.first[same], links.second[same])
    parts = connected_components(coo_array((np.ones(int(same.sum())), pairs), shape=(links.count,) * 2))[1]
    sizes = np.bincount(parts, labelled.visible * wrong)
    if sizes.max() < MIN_ERROR * labelled.visible[labelled.truth].sum():
        return None
    part = np.flatnonzero(wrong & (parts == int(np.argmax(sizes))) & (labelled.visible > 0.0))
    places = labelled.surface.middles()[part]
    middle = places[
        np.argmin(np.linalg.norm(places - np.average(places, axis=0, weights=labelled.visible[part]), axis=1))
    ]
    hits = part[np.argsort(np.linalg.norm(places - middle, axis=1))[:HITS]]
    return hits, bool(labelled.truth[hits[0]])


def rim_clicks(labelled: LabelledScene, links: SplatGraph, count: int = RIM_CLICKS) -> list[np.ndarray]:
    """Return the supervoxels that each of ``count`` clicks on random visible surroundings directly beside the object
    hits."""
    own, rim = labelled.truth, np.zeros(links.count, bool)
    for near, far in ((links.first, links.second), (links.second, links.first)):
        rim[far[own[near] & ~own[far]]] = True
    rim, others = np.flatnonzero(rim & (labelled.visible > 0.0)), np.flatnonzero(~own)
    places, around = labelled.surface.middles(), labelled.surface.middles()[others]
    chosen = np.random.default_rng(0).choice(rim, min(count, len(rim)), replace=False)
    return [others[np.argsort(np.linalg.norm(around - places[one], axis=1))[:HITS]] for one in chosen]


def scores(labelled: LabelledScene, click: Click, weights: EnergyWeights, count: int = 3) -> list[float]:
    """Return the overlap after each of ``count`` clicks, and the mean overlap after a first click and one on the
    rim."""
    scene = click_scene(labelled, click, weights)

    def chosen_by(clicks: Sequence[Observation]) -> np.ndarray:
        evidence = scene.evidence(consistent(clicks, scene.links.count), weights=weights)
        return minimise(scene, evidence, weights=weights)

    first = (np.unique(labelled.surface.cluster[click.hits]), True)
    clicks: list[Observation] = [first]
    result: list[float] = []
    for _ in range(count):
        chosen = chosen_by(clicks)
        result.append(labelled.iou(chosen))
        wrong = correction(labelled, scene.links, chosen)
        if wrong is not None:
            clicks.append(wrong)
    at_rim = [labelled.iou(chosen_by([first, (hits, False)])) for hits in rim_clicks(labelled, scene.links)]
    return [*result, float(np.mean(at_rim))]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = flags(__doc__, quick="two rooms of one seed")
    parser.add_argument("--seeds", nargs="+", type=int, default=[31, 32], help="seeds of the scenes")
    parser.add_argument("--density", type=float, default=0.5, help="factor of the number of Gaussians")
    parser.add_argument("--fit", action="store_true", help="fit the weights of links and supervoxels to the scenes")
    parser.add_argument(
        "--set", nargs=2, action="append", default=[], metavar=("NAME", "VALUE"), help="replace one weight"
    )
    options: argparse.Namespace = parser.parse_args(arguments)
    names, seeds = (list(SCENES)[:2], options.seeds[:1]) if options.quick else (list(SCENES), options.seeds)
    scenes = [LabelledScene.of(name, seed, options.density) for seed in seeds for name in names]
    weights = fitted(scenes) if options.fit else WEIGHTS
    weights = replace(weights, **{name: float(value) for name, value in options.set})
    print(weights)
    table = Table(scene="<26", first=".3f", second=".3f", third=".3f", rim=".3f")
    rows: list[Row] = []
    for labelled in scenes:
        found = np.mean([scores(labelled, click, weights) for click in labelled.clicks], axis=0)
        rows.append({"scene": labelled.name, "iou": [float(one) for one in found]})
        table.row(labelled.name, *found)
    table.row("mean", *np.mean([row["iou"] for row in rows], axis=0))
    table.row("worst", *np.min([row["iou"] for row in rows], axis=0))
    report(options, rows, aims={})


if __name__ == "__main__":
    main()
