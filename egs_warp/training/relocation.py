"""Relocation and addition of Gaussians during training, with the corresponding changes of Adam's state.

The relocation follows Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo". The kernels are in
``egs_warp/kernels/training/population.py``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
import warp as wp

from egs_warp.kernels.training.population import jitter_kernel, regularization_kernel
from egs_warp.launching import launch_rows
from egs_warp.render.autograd import torch_stream
from egs_warp.training.checkpoint import State
from egs_warp.training.growth import Growth

FAINT = 0.005
"""Opacity below which a Gaussian is relocated."""
_MAX_COPIES = 50
_EVERY = 100
"""Number of steps between two relocations."""
_GROWTH, _GROWTH_STEPS = 1.05, 7000
"""Factor by which the number of Gaussians grows at each relocation, and minimum number of steps for this factor.
Shorter training runs have fewer relocations and grow faster, so that they reach the same number."""
_REGULARIZATION = 0.01
"""Weight of the penalties on the mean opacity, and on the mean scale divided by the extent."""
_JITTER = 5e5
"""Amplitude of the noise relative to the learning rate of the means."""
_SETTLING_FROM, _FINAL_RATE = 0.5, 0.1
"""Fraction of the steps after which all learning rates except that of the means decrease, and ratio of the final to the
initial rate."""


class Population:
    """Parameter tensors and one Adam optimiser for all of them. ``relocate`` replaces tensors, so callers must read
    ``tensors`` again in each step."""

    def __init__(
        self,
        tensors: dict[str, torch.Tensor],
        rates: Mapping[str, float],
        *,
        extent: float,
        generator: torch.Generator,
        threads: int | None = None,
    ) -> None:
        wp.init()  # Initialise Warp before it receives torch's tensors.
        self.tensors = tensors
        self.version = 0
        """Number of times that the tensors and their moments were replaced."""
        self._rates = {name: rates[name] * (extent if name == "means" else 1.0) for name in tensors}
        self._extent = extent
        self._generator = generator
        self._threads = threads
        self._optimiser = torch.optim.Adam(
            [{"params": [tensor], "lr": self._rates[name], "name": name} for name, tensor in tensors.items()],
            eps=1e-15,
            fused=True,
        )

    def rates(self, *, done: float, settling: bool = False) -> dict[str, float]:
        """Return the learning rate of each tensor. That of the means decreases to a hundredth as ``done`` goes from 0
        to 1.

        With ``settling``, the other rates decrease to a tenth over the second half of the steps.
        """
        late = max(0.0, done - _SETTLING_FROM) / (1 - _SETTLING_FROM) if settling else 0.0
        return {
            name: rate * (0.01**done if name == "means" else _FINAL_RATE**late) for name, rate in self._rates.items()
        }

    def step(self, rates: Mapping[str, float]) -> None:
        """Take one step of Adam with the given learning rates."""
        for group in self._optimiser.param_groups:
            group["lr"] = rates[group["name"]]
        self._optimiser.step()
        self._optimiser.zero_grad(set_to_none=True)

    def moments(self, name: str) -> tuple[torch.Tensor, torch.Tensor]:
        """Return Adam's first and second moments of a tensor, which have the shape of the tensor."""
        state = self._optimiser.state[self.tensors[name]]
        if not state:
            tensor = self.tensors[name]
            state["step"] = torch.zeros((), device=tensor.device)
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(tensor), torch.zeros_like(tensor)
        return state["exp_avg"], state["exp_avg_sq"]

    def set_step_count(self, steps: int) -> None:
        """Set the number of steps that Adam's bias correction assumes, after steps that changed the tensors and the
        moments directly."""
        for name, tensor in self.tensors.items():
            self.moments(name)
            self._optimiser.state[tensor]["step"].fill_(float(steps))

    def penalty_weights(self) -> tuple[float, float]:
        """Return the weights of the sums of the opacities and of the scales in the penalty on them."""
        count = len(self.tensors["means"])
        return _REGULARIZATION / count, _REGULARIZATION / (3 * count * self._extent)

    def noise_size(self, rate: float) -> float:
        """Return the factor of the noise of the means at their learning ``rate``. For scenes of extent 1, the noise has
        the published amplitude."""
        return _JITTER * rate / self._extent**2

    @torch.no_grad()
    def add_regularization(self) -> None:
        """Add the gradient of a penalty on opacities and scales. The penalty makes useless Gaussians fade, so that they
        can be relocated."""
        opacities, scales = self.tensors["opacity_logits"], self.tensors["log_scales"]
        assert opacities.grad is not None and scales.grad is not None
        count = len(opacities)
        with torch_stream(opacities.device):
            launch_rows(
                regularization_kernel,
                count,
                inputs=[*self.penalty_weights(), _array(opacities), _array(scales)],
                outputs=[_array(opacities.grad), _array(scales.grad)],
                device=wp.device_from_torch(opacities.device),
                threads=self._threads,
            )

    @torch.no_grad()
    def jitter(self, rate: float) -> None:
        """Add noise to the means of faint Gaussians, shaped by each Gaussian's covariance, at the learning ``rate`` of
        the means."""
        means = self.tensors["means"]
        noise = torch.randn(means.shape, generator=self._generator, device=means.device)
        shape = [_array(self.tensors[name]) for name in ("rotations", "log_scales", "opacity_logits")]
        with torch_stream(means.device):
            launch_rows(
                jitter_kernel,
                len(means),
                inputs=[self.noise_size(rate), FAINT, _array(noise), *shape],
                outputs=[_array(means)],
                device=wp.device_from_torch(means.device),
                threads=self._threads,
            )

    @staticmethod
    def is_relocation_due(step: int, steps: int) -> bool:
        """Return True if ``relocate`` changes the Gaussians after ``step`` of ``steps``."""
        # In the last fifth of the steps, the number of Gaussians is constant.
        return step % _EVERY == _EVERY - 1 and step <= 0.8 * steps

    @torch.no_grad()
    def relocate(self, step: int, steps: int, growth: Growth) -> None:
        """At intervals, move faint Gaussians to opaque ones and add new Gaussians.

        The number of Gaussians grows for as long as ``growth`` allows it.
        """
        if not self.is_relocation_due(step, steps):
            return
        opacity = torch.sigmoid(self.tensors["opacity_logits"])
        faint = opacity <= FAINT
        if bool(faint.any()) and not bool(faint.all()):
            places = torch.nonzero(faint)[:, 0]
            chosen = self._draw(torch.where(faint, 0.0, opacity), len(places))
            self._share(chosen)
            for tensor in self.tensors.values():
                tensor[places] = tensor[chosen]
            self._reset_moments(torch.cat([places, chosen]))
        count = len(opacity)
        more = min(growth.cap, int(_growth_factor(steps) * count) + 1) - count
        if more > 0:
            chosen = self._draw(torch.sigmoid(self.tensors["opacity_logits"]), more)
            self._share(chosen)
            self._reset_moments(chosen)
            self._append(chosen)

    def state(self) -> State:
        """Return the state for a checkpoint: parameters, Adam's moments, and the state of the random generator."""
        state: State = {"random": self._generator.get_state().numpy()}
        for name, tensor in self.tensors.items():
            state[name] = tensor.detach().cpu().numpy().copy()
            for key, value in self._optimiser.state.get(tensor, {}).items():
                state[f"{name}.{key}"] = value.cpu().numpy().copy()
        return state

    def restore(self, state: State) -> None:
        """Restore the ``state`` of a checkpoint."""
        self.version += 1
        self._generator.set_state(torch.from_numpy(state["random"]))
        for group in self._optimiser.param_groups:
            old, name = group["params"][0], group["name"]
            new = torch.from_numpy(state[name]).to(old.device).requires_grad_()
            moments = [key for key in state if key.startswith(f"{name}.")]
            if moments:
                self._optimiser.state[new] = {
                    key.removeprefix(f"{name}."): torch.from_numpy(state[key]).to(old.device) for key in moments
                }
            group["params"] = [new]
            self.tensors[name] = new

    def _draw(self, weights: torch.Tensor, count: int) -> torch.Tensor:
        # torch.multinomial takes at most 2^24 weights.
        total = torch.cumsum(weights.double(), 0)
        spots = torch.rand(count, generator=self._generator, device=weights.device, dtype=torch.float64) * total[-1]
        return torch.searchsorted(total, spots).clamp_max(len(weights) - 1)

    def _share(self, chosen: torch.Tensor) -> None:
        """Set the opacity and the scale of each chosen Gaussian such that it and its copies together render like the
        original."""
        opacity = torch.sigmoid(self.tensors["opacity_logits"])
        copies = torch.bincount(chosen, minlength=len(opacity))
        unique = torch.nonzero(copies)[:, 0]
        number = (copies[unique] + 1).clamp_max(_MAX_COPIES)
        old = opacity[unique].double().clamp(FAINT, 1 - 1e-6)
        new = 1 - (1 - old) ** (1 / number)
        total = torch.zeros_like(old)
        for i in range(1, int(number.max()) + 1):
            term = torch.zeros_like(old)
            for k in range(i):
                term += math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * new ** (k + 1)
            total += torch.where(number >= i, term, 0.0)
        new = new.clamp(FAINT, 1 - 1e-6)
        self.tensors["opacity_logits"][unique] = torch.logit(new).float()
        self.tensors["log_scales"][unique] += torch.log(old / total).float()[:, None]

    def _reset_moments(self, indices: torch.Tensor) -> None:
        for tensor in self.tensors.values():
            for value in self._optimiser.state.get(tensor, {}).values():
                if torch.is_tensor(value) and value.shape == tensor.shape:
                    value[indices] = 0.0

    def _append(self, chosen: torch.Tensor) -> None:
        self.version += 1
        for group in self._optimiser.param_groups:
            old = group["params"][0]
            new = torch.cat([old, old[chosen]]).detach().requires_grad_()
            state = self._optimiser.state.pop(old, {})
            for key, value in state.items():
                if torch.is_tensor(value) and value.shape == old.shape:
                    state[key] = torch.cat([value, torch.zeros_like(value[chosen])])
            if state:
                self._optimiser.state[new] = state
            group["params"] = [new]
            self.tensors[group["name"]] = new


def _growth_factor(steps: int) -> float:
    """Return the factor by which the number of Gaussians grows at each relocation in a training run of ``steps``."""
    return _GROWTH ** max(1.0, _GROWTH_STEPS / steps)


def _array(tensor: torch.Tensor) -> wp.array:
    """View the contiguous ``tensor`` (n,), (n, 3) or (n, 4) as a Warp array of length n, without a copy."""
    dtype = {1: wp.float32, 3: wp.vec3, 4: wp.vec4}[1 if tensor.ndim == 1 else tensor.shape[1]]
    device = wp.device_from_torch(tensor.device)
    return wp.array(ptr=tensor.data_ptr(), dtype=dtype, shape=(len(tensor),), device=device)
