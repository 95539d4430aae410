"""``plots.png``: time series of a run, from its trajectory and energy balance."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from egs_warp.io.atomic import atomic_write
from egs_warp.locomotion.ledger import EnergyBalance
from egs_warp.locomotion.trajectory import Trajectory
from egs_warp.pipelines.report import AUDIT_LIMITS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_STORED = {
    "potential": "potential",
    "elastic": "elastic",
    "kinetic_com": "kinetic: centre of mass",
    "kinetic_rotation": "kinetic: rotation",
    "kinetic_deformation": "kinetic: deformation",
}
_FLOWS = {
    "muscles": ("muscles",),
    "pushes": ("pushes",),
    "damping": ("damping",),
    "friction": ("friction",),
    "contact and push-out": ("contact", "push_out"),
    "joints": ("joints",),
    "air": ("drag",),
    "lost by the integrator": ("lost_inertia", "lost_elastic", "lost_muscle", "lost_damping"),
    "restored spin": ("spin_inside", "spin_after"),
}
_COLOUR_PERCENTILE = 99.0
"""Percentile of the tensions that is the upper end of the colour scale."""


def draw_plots(path: Path, trajectory: Trajectory, energy: EnergyBalance) -> None:
    """Write the plots to ``path``: stored energies and cumulative energy flows, load on the ground, energy residual,
    planned and simulated centre of mass, and muscle tensions."""
    # Imported here because the import takes a quarter of a second.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 12.0), layout="constrained")
    panels = figure.subplots(3, 2)
    _draw_stored(panels[0, 0], trajectory, energy)
    _draw_flows(panels[0, 1], trajectory, energy)
    _draw_load(panels[1, 0], trajectory)
    _draw_residual(panels[1, 1], trajectory, energy)
    _draw_centre(panels[2, 0], trajectory)
    _draw_muscles(panels[2, 1], trajectory)
    for axes in panels.flat:
        axes.set_xlabel("s")
        axes.set_xlim(trajectory.time[0], max(trajectory.time[-1], trajectory.time[0] + 1e-9))
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=100, format="png")


def _draw_stored(axes: Axes, t: Trajectory, energy: EnergyBalance) -> None:
    for name, label in _STORED.items():
        values = getattr(energy, name)
        axes.plot(t.time, (values - (values[0] if name == "potential" else 0.0)) / energy.energy_unit, label=label)
    axes.set_title("Energy in the body, divided by m g H")
    axes.legend(fontsize="small")


def _draw_flows(axes: Axes, t: Trajectory, energy: EnergyBalance) -> None:
    total = np.zeros(len(t.time))
    for label, names in _FLOWS.items():
        if label == "joints" and not len(t.joint_step):
            continue
        flow = np.concatenate([[0.0], np.sum([getattr(energy, name) for name in names], axis=0).cumsum()])
        total += flow
        axes.plot(t.time, flow / energy.energy_unit, label=f"{label} {flow[-1] / energy.energy_unit:+.2f}")
    axes.plot(t.time, total / energy.energy_unit, "k", linewidth=2.0, label="sum")
    axes.plot(t.time, (energy.stored - energy.stored[0]) / energy.energy_unit, "w--", linewidth=1.0, label="gained")
    axes.set_title("Energy flows since the start, divided by m g H")
    axes.legend(fontsize="small", facecolor="0.85", ncols=3, loc="upper center", bbox_to_anchor=(0.5, -0.14))


def _draw_load(axes: Axes, t: Trajectory) -> None:
    normal = np.einsum("ci,ci->c", t.contact_force, t.contact_normal)
    rubbing = np.linalg.norm(t.contact_force - normal[:, None] * t.contact_normal, axis=1)
    weight = t.node_mass.sum() * np.linalg.norm(t.gravity)
    external = ~t.is_self_contact
    for force, label in ((normal, "normal"), (rubbing, "friction")):
        load = np.bincount(t.contact_step[external], force[external], minlength=len(t.dt)) / weight
        axes.stairs(load, t.time, label=label)
    axes.set_title("Load on the ground, body weights")
    axes.legend(fontsize="small")


def _draw_residual(axes: Axes, t: Trajectory, energy: EnergyBalance) -> None:
    residual = np.abs(energy.residual)
    axes.stairs(np.maximum(residual, 1e-17), t.time, label="residual of a step", baseline=1e-17)
    axes.axhline(AUDIT_LIMITS["energy_residual"], color="k", linestyle=":", label="bound")
    axes.set_yscale("log")
    axes.set_title(f"Energy balance: closes to {residual.max(initial=0.0):.1e} of m g H")
    axes.legend(fontsize="small")


def _draw_centre(axes: Axes, t: Trajectory) -> None:
    up = -t.gravity / np.linalg.norm(t.gravity)
    com = np.einsum("n,fni->fi", t.node_mass, t.positions) / t.node_mass.sum()
    left = np.cross(up, t.front)
    left /= np.linalg.norm(left)
    for direction, label, colour in ((up, "up", "C0"), (np.cross(left, up), "ahead", "C1"), (left, "left", "C2")):
        axes.plot(t.time, (com - com[0]) @ direction / t.height, colour, label=label)
        if len(t.planned_com):
            axes.plot(
                t.time, (t.planned_com - com[0]) @ direction / t.height, colour, linestyle="--", label=f"{label}, plan"
            )
    axes.set_title("Centre of mass since the start, body heights")
    axes.legend(fontsize="small")


def _draw_muscles(axes: Axes, t: Trajectory) -> None:
    pull = (t.activations * t.muscle_stiffness).T / (t.node_mass.sum() * np.linalg.norm(t.gravity))
    axes.set_title("Tension of the muscle segments, body weights")
    axes.set_ylabel("segment")
    if pull.size == 0:
        return
    reach = max(float(np.percentile(np.abs(pull), _COLOUR_PERCENTILE)), 1e-9)
    rows = np.arange(len(pull) + 1)
    mesh = axes.pcolormesh(t.time, rows, pull, cmap="RdBu_r", vmin=-reach, vmax=reach, rasterized=True)
    figure = axes.get_figure()
    assert figure is not None
    figure.colorbar(mesh, ax=axes)
