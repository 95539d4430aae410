"""Gaussians under training as a population: Adam's state follows them as they move and multiply.

The relocation is that of Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo".
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
import warp as wp

from egs_warp.kernels.training.population import jitter_kernel, pull_kernel
from egs_warp.launching import launch_rows
from egs_warp.render.autograd import torch_stream
from egs_warp.training.checkpoint import State
from egs_warp.training.growth import Growth

_FAINT = 0.005
"""Opacity below which a Gaussian is moved."""
_MAX_COPIES = 50
_EVERY = 100
"""Steps between relocations."""
_GROWTH = 1.05
"""Least factor by which the number of Gaussians grows at each."""
_GROWN_AT_BEST, _GROWN_AT_LAST = 0.3, 0.5
"""Shares of the steps at which a cap that was asked for is reached: early where that is gentle, by half time anyway."""
_GENTLE = 1.1
"""Factor above which copies outrun what the photos can tell them apart by."""
_PULL = 0.01
"""Weight of the mean opacity and of the mean scale over the extent."""
_JITTER = 5e5
"""Noise over the rate of the means."""
_SETTLING_FROM, _SETTLED = 0.5, 0.1
"""Share of the steps from which the rates of all but the means fall, and to which part."""


class Population:
    """Parameter tensors with one Adam for all; ``evolve`` replaces tensors, so ask ``tensors`` anew each step."""

    def __init__(
        self,
        tensors: dict[str, torch.Tensor],
        rates: Mapping[str, float],
        *,
        extent: float,
        generator: torch.Generator,
    ) -> None:
        wp.init()  # torch's tensors are handed over before any kernel is launched
        self.tensors = tensors
        self._rates = {name: rates[name] * (extent if name == "means" else 1.0) for name in tensors}
        self._extent = extent
        self._generator = generator
        on_gpu = next(iter(tensors.values())).is_cuda
        self._optimiser = torch.optim.Adam(
            [{"params": [tensor], "lr": self._rates[name], "name": name} for name, tensor in tensors.items()],
            eps=1e-15,
            fused=on_gpu or None,
        )

    def step(self, *, done: float, settling: bool = False) -> None:
        """One step of Adam; the rate of the means falls to a hundredth as ``done`` goes from 0 to 1.

        With ``settling`` the others fall to a tenth over the last part.
        """
        late = max(0.0, done - _SETTLING_FROM) / (1 - _SETTLING_FROM) if settling else 0.0
        for group in self._optimiser.param_groups:
            group["lr"] = self._rates[group["name"]] * (0.01**done if group["name"] == "means" else _SETTLED**late)
        self._optimiser.step()
        self._optimiser.zero_grad(set_to_none=True)

    @torch.no_grad()
    def add_regularization(self) -> None:
        """Add to the gradients a pull on opacities and scales: useless Gaussians fade, and can then be moved."""
        opacities, scales = self.tensors["opacity_logits"], self.tensors["log_scales"]
        assert opacities.grad is not None and scales.grad is not None
        count = len(opacities)
        with torch_stream(opacities.device):
            launch_rows(
                pull_kernel,
                count,
                inputs=[_PULL / count, _PULL / (3 * count * self._extent), _array(opacities), _array(scales)],
                outputs=[_array(opacities.grad), _array(scales.grad)],
                device=wp.device_from_torch(opacities.device),
            )

    @torch.no_grad()
    def relocate(self, step: int, steps: int, growth: Growth) -> None:
        """Jitter the means; now and then move faint Gaussians onto opaque ones and grow.

        A cap that was asked for is reached by half time or before; else the number grows at the least pace, while
        ``growth`` lets it.
        """
        self._jitter()
        # The last fifth of the steps settles what is there.
        if step % _EVERY != _EVERY - 1 or step > 0.8 * steps:
            return
        opacity = torch.sigmoid(self.tensors["opacity_logits"])
        faint = opacity <= _FAINT
        if bool(faint.any()) and not bool(faint.all()):
            places = torch.nonzero(faint)[:, 0]
            chosen = self._draw(torch.where(faint, 0.0, opacity), len(places))
            self._share(chosen)
            for tensor in self.tensors.values():
                tensor[places] = tensor[chosen]
            self._forget(torch.cat([places, chosen]))
        count = len(opacity)
        pace = _GROWTH if growth.asked is None else _pace(growth.cap / count, step, steps)
        more = min(growth.cap, int(pace * count) + 1) - count
        if more > 0:
            chosen = self._draw(torch.sigmoid(self.tensors["opacity_logits"]), more)
            self._share(chosen)
            self._forget(chosen)
            self._append(chosen)

    def state(self) -> State:
        """All that lasts from step to step: parameters, Adam's moments, random numbers."""
        state: State = {"random": self._generator.get_state().numpy()}
        for name, tensor in self.tensors.items():
            state[name] = tensor.detach().cpu().numpy().copy()
            for key, value in self._optimiser.state.get(tensor, {}).items():
                state[f"{name}.{key}"] = value.cpu().numpy().copy()
        return state

    def restore(self, state: State) -> None:
        """Go on from ``state``."""
        self._generator.set_state(torch.from_numpy(state["random"]))
        for group in self._optimiser.param_groups:
            old, name = group["params"][0], group["name"]
            new = torch.from_numpy(state[name]).to(old.device).requires_grad_()
            moments = [key for key in state if key.startswith(f"{name}.")]
            # Adam counts its steps on the host, unless it is fused.
            places = {key: old.device if group["fused"] or not key.endswith(".step") else "cpu" for key in moments}
            if moments:
                self._optimiser.state[new] = {
                    key.removeprefix(f"{name}."): torch.from_numpy(state[key]).to(places[key]) for key in moments
                }
            group["params"] = [new]
            self.tensors[name] = new

    def _draw(self, weights: torch.Tensor, count: int) -> torch.Tensor:
        # Not torch.multinomial, which takes at most 2^24 weights.
        total = torch.cumsum(weights.double(), 0)
        spots = torch.rand(count, generator=self._generator, device=weights.device, dtype=torch.float64) * total[-1]
        return torch.searchsorted(total, spots).clamp_max(len(weights) - 1)

    def _share(self, chosen: torch.Tensor) -> None:
        """Opacity and scale of each chosen Gaussian such that it and its copies together look as it did alone."""
        opacity = torch.sigmoid(self.tensors["opacity_logits"])
        copies = torch.bincount(chosen, minlength=len(opacity))
        unique = torch.nonzero(copies)[:, 0]
        number = (copies[unique] + 1).clamp_max(_MAX_COPIES)
        old = opacity[unique].double().clamp(_FAINT, 1 - 1e-6)
        new = 1 - (1 - old) ** (1 / number)
        total = torch.zeros_like(old)
        for i in range(1, int(number.max()) + 1):
            term = torch.zeros_like(old)
            for k in range(i):
                term += math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * new ** (k + 1)
            total += torch.where(number >= i, term, 0.0)
        new = new.clamp(_FAINT, 1 - 1e-6)
        self.tensors["opacity_logits"][unique] = torch.logit(new).float()
        self.tensors["log_scales"][unique] += torch.log(old / total).float()[:, None]

    def _forget(self, which: torch.Tensor) -> None:
        for tensor in self.tensors.values():
            for value in self._optimiser.state.get(tensor, {}).values():
                if torch.is_tensor(value) and value.shape == tensor.shape:
                    value[which] = 0.0

    def _append(self, chosen: torch.Tensor) -> None:
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

    def _jitter(self) -> None:
        """Noise of each Gaussian's own shape on the faint ones' means, as published for scenes of extent 1."""
        rate = next(group["lr"] for group in self._optimiser.param_groups if group["name"] == "means")
        means = self.tensors["means"]
        noise = torch.randn(means.shape, generator=self._generator, device=means.device)
        shape = [_array(self.tensors[name]) for name in ("rotations", "log_scales", "opacity_logits")]
        with torch_stream(means.device):
            launch_rows(
                jitter_kernel,
                len(means),
                inputs=[_JITTER * rate / self._extent**2, _FAINT, _array(noise), *shape],
                outputs=[_array(means)],
                device=wp.device_from_torch(means.device),
            )


def _pace(ratio: float, step: int, steps: int) -> float:
    """Factor of growth at ``step`` of ``steps``, where there are to be ``ratio`` times as many in the end."""
    best, last = (
        ratio ** (1 / max(1, round((share * steps - step) / _EVERY))) for share in (_GROWN_AT_BEST, _GROWN_AT_LAST)
    )
    return max(_GROWTH, min(best, _GENTLE), last)


def _array(tensor: torch.Tensor) -> wp.array:
    """The contiguous ``tensor`` (n,), (n, 3) or (n, 4) as an array of n, without a copy."""
    dtype = {1: wp.float32, 3: wp.vec3, 4: wp.vec4}[1 if tensor.ndim == 1 else tensor.shape[1]]
    device = wp.device_from_torch(tensor.device)
    return wp.array(ptr=tensor.data_ptr(), dtype=dtype, shape=(len(tensor),), device=device)
