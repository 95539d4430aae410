"""Deliberately wrong formulas, each with the test that must fail; ``tests/test_formula_mutations.py`` runs them.

When a formula of the package is rewritten, its line in this file must be rewritten, too.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Mutation:
    """Deliberately wrong formula."""

    what: str
    """Name of the formula, with its equation in the paper as "Eq. (n)" if it has one."""
    file: str
    """File of the package."""
    right: str
    """Correct text, which occurs exactly once in the file."""
    wrong: str
    test: str
    """Test that fails, as file::function."""


def _equation(number: int, what: str, file: str, right: str, wrong: str, test: str) -> Mutation:
    return Mutation(f"Eq. ({number}): {what}", file, right, wrong, test)


EQUATIONS: dict[int, Mutation] = {
    number: _equation(number, what, f"egs_warp/{file}", right, wrong, f"tests/{test}")
    for number, what, file, right, wrong, test in [
        (
            *(1, "the plane's sign", "geometry/plane.py"),
            *("self.normal + self.offset", "self.normal - self.offset"),
            "segmentation/test_plane_fit.py::test_plane_measures_height_towards_the_objects_side",
        ),
        (
            *(2, "the order of the weights", "kernels/deformation/embedding.py"),
            *("w[2], w[0], w[1], w[2])", "w[2], w[1], w[0], w[2])"),
            "deformation/test_embedding.py::test_weights_reproduce_points_and_shared_faces_take_the_lowest_tet",
        ),
        (
            *(3, "the shortening of arms that extend below the plane", "contact/detection.py"),
            *("means[above] + reach[:, None] * arm", "means[above] + arm"),
            "contact/test_detection.py::test_endpoints_are_shortened_to_the_plane_at_rest",
        ),
        (
            *(4, "the weight's factor dt", "fem/implicit_step.py"),
            *("self.state.velocities - self.dt * self", "self.state.velocities - 1.01 * self.dt * self"),
            "fem/test_step_problem.py::test_free_fall_follows_the_discrete_parabola",
        ),
        (
            *(5, "the half of lambda log^2 J", "kernels/fem/elasticity_cpu.py"),
            *("mu * log_j + 0.5 * lam * log_j", "mu * log_j + 0.6 * lam * log_j"),
            "fem/test_elasticity.py::test_gradient_is_derivative_of_energy",
        ),
        (
            *(6, "the drag on the end velocity", "fem/implicit_step.py"),
            *(
                "change = self.inertia_ratio * velocities",
                "change = velocities + (self.inertia_ratio - 1.0) * self.state.velocities",
            ),
            "fem/test_step_problem.py::test_drag_slows_free_flight_exponentially",
        ),
        (
            *(7, "the direction of a segment's tension", "muscles/tension.py"),
            *("pulls = -(muscles.stiffness * share)", "pulls = (muscles.stiffness * share)"),
            "muscles/test_muscle_set.py::test_columns_are_equation_7",
        ),
        (
            *(8, "the plane's offset", "kernels/contact/gaps.py"),
            *("plane[2] * x[3 * i + 2] + plane[3]", "plane[2] * x[3 * i + 2] - plane[3]"),
            "contact/test_detection.py::test_gaps_kernel_equals_its_twin",
        ),
        (
            *(9, "the radius of Coulomb's cone", "kernels/contact/coulomb.py"),
            *(
                "radius = contacts.friction * wp.max(normal, real(0.0))",
                "radius = real(1.02) * contacts.friction * wp.max(normal, real(0.0))",
            ),
            "contact/test_detection.py::test_coulomb_forces_on_random_problems",
        ),
        (
            *(10, "the velocity bias of the predicted contact", "contact/newton.py"),
            *(
                "(self._regular, speeds, shift, friction, start)",
                "(self._regular, speeds, shift + 0.1, friction, start)",
            ),
            "contact/test_coupled_step.py::test_predicted_forces_obey_coulombs_law",
        ),
        (
            *(11, "Coulomb's limit", "kernels/contact/coulomb.py"),
            *("            share = radius / pull\n        newton", "            share = real(1.0)\n        newton"),
            "contact/test_coupled_step.py::test_predicted_forces_obey_coulombs_law",
        ),
        (
            *(12, "the direction of the slip", "locomotion/paper_strategy.py"),
            *("slide = np.argmin(predicted.velocities", "slide = np.argmax(predicted.velocities"),
            "locomotion/test_paper_strategy.py::test_predicted_modes",
        ),
        (
            *(13, "the width of the friction pyramid", "locomotion/contact_modes.py"),
            *("width = math.cos(math.pi / directions)", "width = 1.0"),
            "locomotion/test_paper_strategy.py::test_a_region_is_the_program_with_complementarity_in_the_same_states",
        ),
        (
            *(14, "the mean of F+ and F-", "kernels/deformation/deformer.py"),
            *("average = 0.5 * (both.plus + both.minus)", "average = both.plus"),
            "deformation/test_deformer.py::test_arms_follow_their_ends",
        ),
        (
            *(15, "the rotation of the colour", "kernels/deformation/deformer.py"),
            *(
                "result.polar_rotation = quaternion_from_rotation(turned * wp.transpose(axes))",
                "result.polar_rotation = quaternion_from_rotation(axes * wp.transpose(turned))",
            ),
            "deformation/test_deformer.py::test_a_rotated_cage_rotates_shape_and_colour_exactly",
        ),
        (
            *(16, "the bend's angle", "kernels/deformation/deformer.py"),
            *("wp.trace(between) - 1.0", "wp.trace(between) + 1.0"),
            "deformation/test_deformer.py::test_bend_angle_is_the_angle_between_the_arms",
        ),
        (
            *(17, "the children's distance", "deformation/splitting.py"),
            *("np.array([-1.0, 1.0]) * np.sqrt(2.0 / np.pi)", "np.array([-1.0, 1.0]) * np.sqrt(0.5 * np.pi)"),
            "deformation/test_splitting.py::test_children_keep_mean_and_covariance",
        ),
        (
            *(18, "depth along the ray, not distance", "segmentation/plane_fit.py"),
            *(
                "-height / np.where(slope == 0.0, np.inf, slope)",
                "-height / np.where(slope == 0.0, np.inf, 1.001 * slope)",
            ),
            "segmentation/test_plane_fit.py::test_depth_puts_every_pixel_on_the_plane",
        ),
        (
            *(19, "the residual", "segmentation/plane_fit.py"),
            *("(self.rays @ plane.normal) + camera) / camera", "(self.rays @ plane.normal) + 1.01 * camera) / camera"),
            "segmentation/test_plane_fit.py::test_exact_depth_gives_the_exact_plane",
        ),
        (
            *(20, "the longest tip", "kernels/segmentation/clearance.py"),
            *("axis_reach_out[row] = wp.max(w)", "axis_reach_out[row] = wp.min(w)"),
            "segmentation/test_clearance.py::test_reach_is_that_of_the_six_tips_or_of_the_whole_ellipsoid",
        ),
        (
            *(21, "the loss of a straddling Gaussian", "segmentation/clearance.py"),
            *("torch.relu(eta - height.abs())", "torch.relu(eta - height)"),
            "segmentation/test_clearance.py::test_loss_is_the_sum_over_straddling_gaussians",
        ),
    ]
}
"""One mutation of each equation of the paper; ``docs/equations.md`` lists where else it is implemented and tested."""

OTHER_FORMULAS: list[Mutation] = [
    Mutation(what, f"egs_warp/{file}", right, wrong, f"tests/{test}")
    for what, file, right, wrong, test in [
        (
            *("SSIM's window", "training/metrics.py", "(2 * 1.5**2)", "(2 * 1.6**2)"),
            "training/test_finetune.py::test_ssim_equals_scikit_images",
        ),
        (
            *("SSIM's constants", "training/metrics.py", "0.01**2, 0.03**2", "0.01**2, 0.01**2"),
            "training/test_finetune.py::test_ssim_equals_scikit_images",
        ),
        (
            *("MCMC's noise: Sigma, not its root", "kernels/training/population.py"),
            *("wp.exp(2.0 * s[0]) * local[0]", "wp.exp(s[0]) * local[0]"),
            "training/test_finetune.py::test_the_noise_of_mcmc_has_the_covariance_of_the_shape_squared",
        ),
        (
            *(
                "MCMC's noise: the axes",
                "kernels/training/population.py",
                "(turn * local)",
                "(wp.transpose(turn) * local)",
            ),
            "training/test_finetune.py::test_the_noise_of_mcmc_has_the_covariance_of_the_shape_squared",
        ),
        (
            *(
                "MCMC's noise: the gate",
                "kernels/training/population.py",
                "STEEPNESS = wp.constant(wp.float32(100.0))",
                "STEEPNESS = wp.constant(wp.float32(80.0))",
            ),
            "training/test_finetune.py::test_the_noise_of_mcmc_has_the_covariance_of_the_shape_squared",
        ),
        (
            *("fTetWild: always the lattice instead", "meshing/tetwild.py"),
            *("return TetMesh.oriented(nodes, tets)", "return None"),
            "meshing/test_cage.py::test_tetwild",
        ),
        (
            *("the work of a push: the factor 1/2 of the velocity change", "locomotion/ledger.py"),
            *("t.velocities[step] + 0.5 * kick", "t.velocities[step] + kick"),
            "locomotion/test_ledger.py::test_the_work_of_a_push_is_the_kinetic_energy_that_it_adds",
        ),
        (
            *("the loss of a push by implicit Euler", "locomotion/ledger.py"),
            *("velocity - t.velocities[step] - kick)", "velocity - t.velocities[step])"),
            "locomotion/test_ledger.py::test_every_step_closes",
        ),
        (
            *("the torque of a push", "locomotion/audit.py"),
            *("np.cross(arms[t.kick_step], impulses)", "np.cross(t.positions[t.kick_step], impulses)"),
            "locomotion/test_audit.py::test_a_missing_misplaced_or_late_push_is_detected",
        ),
        (
            *("a push's change of speed", "motions/push.py"),
            *("(body.node_mass @ near) *", "near.sum() *"),
            "motions/test_push.py::test_a_push_has_its_momentum_and_its_lever_arm",
        ),
        (
            *("a gust's end", "motions/push.py"),
            *("max(min(end, dt) - max(start, 0.0), 0.0)", "max(dt - max(start, 0.0), 0.0)"),
            "motions/test_push.py::test_steps_share_out_all_of_a_push",
        ),
        (
            *("the curve of the momentum residual: pushes", "web/recording.py"),
            *("force + kicked - t.drag", "force - t.drag"),
            "web/test_recording.py::test_the_momentum_curve_includes_pushes",
        ),
        (
            *("the impulse of a pull over a step", "web/spring.py"),
            *("return dt * self._shares", "return 0.5 * dt * self._shares"),
            "web/test_spring.py::test_a_step_under_a_pull_has_its_impulse_and_its_torque",
        ),
        (
            *("a jump's plan: half a step of gravity", "motions/jump_plan.py"),
            *("(2.0 * gravity * rise) + 0.5 * gravity * step", "(2.0 * gravity * rise)"),
            "motions/test_jump_plan.py::test_a_body_that_follows_the_plan_reaches_height_and_distance",
        ),
        (
            *("a jump's plan: half a step of the thrust", "motions/jump_plan.py"),
            *("stroke += 0.5 * speed_up * step", "stroke += speed_up * step"),
            "motions/test_jump_plan.py::test_a_body_that_follows_the_plan_reaches_height_and_distance",
        ),
        (
            *("a jump's plan: the time down to a landing that is higher", "motions/jump_plan.py"),
            *("max(rise - target.rise, 0.0) / gravity)", "max(rise + target.rise, 0.0) / gravity)"),
            "motions/test_jump_plan.py::test_a_body_that_follows_the_plan_reaches_height_and_distance",
        ),
        (
            *("a jump's plan: the capture point", "motions/jump_plan.py"),
            *("swaying = np.sqrt(gravity / com_height)", "swaying = np.sqrt(1.3 * gravity / com_height)"),
            "motions/test_jump_plan.py::test_a_body_that_follows_the_plan_reaches_height_and_distance",
        ),
        (
            *("a jump's plan: the load of a landing", "motions/jump_plan.py"),
            *("(gravity + fall_speed / duration)", "(fall_speed / duration)"),
            "motions/test_jump_plan.py::test_feet_stop_a_body_with_a_gradual_landing",
        ),
        (
            *("balance: the centre of pressure under load", "motions/balance.py"),
            *("(height / up)[..., None] * (level + turn) / dt", "(height / gravity)[..., None] * (level + turn) / dt"),
            "motions/test_stance.py::test_balance_targets_are_the_nearest_that_do_not_tip",
        ),
        (
            *("balance: the friction limit under load", "motions/balance.py"),
            *("load = up[..., None] * np", "load = gravity * np"),
            "motions/test_stance.py::test_requests_are_limited_by_friction",
        ),
        (
            *("balance: the margin of the footprint", "motions/balance.py"),
            *("measurement.support.scaled(SUPPORT_MARGIN)", "measurement.support"),
            "motions/test_stance.py::test_balance_targets_are_the_nearest_that_do_not_tip",
        ),
        (
            *("the maximum rotation: the lever arm of a disc", "motions/turn.py"),
            *("2.0 / 3.0 * float(", "3.0 / 4.0 * float("),
            "motions/test_turn.py::test_the_largest_turn_is_that_of_a_disc_on_rough_ground",
        ),
        (
            *("the maximum rotation: the impulse of the weight", "motions/turn.py"),
            *("(plan.speed_up + jump.gravity * plan.thrust_time)", "plan.speed_up"),
            "motions/test_turn.py::test_the_largest_turn_is_that_of_a_disc_on_rough_ground",
        ),
        (
            *("the maximum rotation: the friction pyramid", "motions/turn.py"),
            *("rate = PYRAMID_FRICTION_RATIO * stance.friction", "rate = stance.friction"),
            "motions/test_turn.py::test_the_largest_turn_is_that_of_a_disc_on_rough_ground",
        ),
        (
            *("twist: the angular velocity of the standing body, not of the crouched one", "motions/twist.py"),
            *("momenta[rows] = times(inertia, spin)", "momenta[rows] = times(measurement.inertia[rows], spin)"),
            "motions/test_twist.py::test_a_twist_requests_the_remaining_spin_from_friction",
        ),
        (
            *("twist: the time of flight", "motions/twist.py"),
            *("airborne = AIRBORNE_FRACTION * flight_time", "airborne = 2.0 * AIRBORNE_FRACTION * flight_time"),
            "motions/test_twist.py::test_a_twist_requests_the_remaining_spin_from_friction",
        ),
        (
            *("twist: a free body conserves its angular momentum, not its angular velocity", "motions/free_turn.py"),
            *("times(axes @ inverse, times(axes.swapaxes(-1, -2), momentum))", "times(inverse, momentum)"),
            "motions/test_free_turn.py::test_a_symmetric_top_precesses_about_its_angular_momentum",
        ),
        (
            *("twist: arms as the square root of the inertia", "motions/twist.py"),
            *("width = np.where(self.turns, np.sqrt(np.clip(", "width = np.where(self.turns, (np.clip("),
            "motions/test_twist.py::test_in_the_air_the_width_is_adjusted_to_the_turn",
        ),
        (
            *("radial fibres: their tension", "muscles/tension.py"),
            *("entries = rows.data[:, None] *", "entries = 1.1 * rows.data[:, None] *"),
            "muscles/test_muscle_set.py::test_radial_fibres_lengthen_by_poissons_ratio",
        ),
        (
            *("radial fibres: the radius of their ends", "muscles/branch_cylinder.py"),
            *("_RADIUS_FRACTION * reach * outwards", "0.5 * reach * outwards"),
            "muscles/test_muscle_set.py::test_radial_fibres_are_diameters_spread_over_length_and_directions",
        ),
        (
            *("radial fibres: the distribution over directions", "muscles/branch_cylinder.py"),
            *("diameter * count // (2 * self.detail.diameters)", "0"),
            "muscles/test_muscle_set.py::test_radial_fibres_are_diameters_spread_over_length_and_directions",
        ),
        (
            *("energy balance: the factor 1/2 of lambda log^2 J", "locomotion/ledger.py"),
            *("+ 0.5 * self.lam * log_j**2", "+ 0.51 * self.lam * log_j**2"),
            "locomotion/test_ledger.py::test_every_step_closes",
        ),
        (
            *("energy balance: the strain rate of the damping", "locomotion/ledger.py"),
            *("np.swapaxes(F0, 1, 2) @ F0) / (2.0 * dt)", "np.swapaxes(F0, 1, 2) @ F0) / (1.98 * dt)"),
            "locomotion/test_ledger.py::test_every_step_closes",
        ),
        (
            *("energy balance: the loss of elastic energy in a step", "locomotion/ledger.py"),
            *("(self.lam * log_j - self.mu) * curved", "(self.lam * log_j + self.mu) * curved"),
            "locomotion/test_ledger.py::test_every_step_closes",
        ),
        (
            *("energy balance: the factor 1/2 of the loss of a rotating muscle", "locomotion/ledger.py"),
            *("turned = 0.5 * share * long", "turned = 0.6 * share * long"),
            "locomotion/test_ledger.py::test_every_step_closes",
        ),
        (
            *("energy balance: the factor 1/2 of the integrator's loss of kinetic energy", "locomotion/ledger.py"),
            *("-0.5 * _squared(mass, velocity - t.", "-0.51 * _squared(mass, velocity - t."),
            "locomotion/test_ledger.py::test_every_step_closes",
        ),
        (
            *("energy balance: the lever arms of the removed torque", "locomotion/ledger.py"),
            *(
                "inner_spin @ _momentum(mass, before, velocity)",
                "inner_spin @ _momentum(mass, after, t.velocities[step])",
            ),
            "locomotion/test_ledger.py::test_every_step_closes",
        ),
        (
            *("energy balance: the energy of the added angular velocity", "locomotion/ledger.py"),
            *("+ 0.5 * _inertia(mass, after) @ added", "+ 1.0 * _inertia(mass, after) @ added"),
            "locomotion/test_ledger.py::test_spin_added_after_a_step_counts",
        ),
        (
            *("audit: friction against slip", "locomotion/audit.py"),
            *('+ np.einsum("ci,ci->c", tangential, slip)', '- np.einsum("ci,ci->c", tangential, slip)'),
            "locomotion/test_audit.py::test_a_run_that_slides_passes",
        ),
        (
            *("audit: the gap at the end of the step", "locomotion/audit.py"),
            *("normal * np.maximum(_start_gaps(t) + along, 0.0)", "normal * np.maximum(_start_gaps(t), 0.0)"),
            "locomotion/test_audit.py::test_a_run_that_slides_passes",
        ),
        (
            *("audit: the torque of contact", "locomotion/audit.py"),
            *("np.cross(start_points(t) - com[t.contact_step]", "np.cross(start_points(t)"),
            "locomotion/test_audit.py::test_a_run_that_slides_passes",
        ),
        (
            *("world audit: the slip relative to the other body", "locomotion/world_audit.py"),
            *("contact_displacements(t)[1][i] - contact_displacements(u)[1][j]", "contact_displacements(t)[1][i]"),
            "locomotion/test_world_audit.py::test_a_correct_run_passes",
        ),
        (
            *("uneven ground: the distance from its tangent plane", "kernels/contact/height_field.py"),
            *("real(1.0) + first * first + second * second", "real(1.0) + first * first"),
            "contact/test_terrain.py::test_the_kernel_equals_its_twin",
        ),
        (
            *("uneven ground: its normal", "geometry/height_field.py"),
            *("np.stack([-first, -second, one], axis=1)", "np.stack([-first, second, one], axis=1)"),
            "geometry/test_height_field.py::test_normals_are_the_gradient_of_the_gap",
        ),
        (
            *("audit: the gap to uneven ground", "locomotion/audit.py"),
            *("- lift) * (normals @ t.ground_axes[2])", "- 1.01 * lift) * (normals @ t.ground_axes[2])"),
            "contact/test_terrain.py::test_the_drop_passes_the_audit",
        ),
    ]
]
"""Mutations of formulas that are not in the paper."""

ALL = [*EQUATIONS.values(), *OTHER_FORMULAS]
