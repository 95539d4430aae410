"""A Gaussian with extreme values is either rejected, with the name of the attribute, or has no harmful effect: images,
gradients, motion, splits and training stay finite, and all other Gaussians are bitwise unchanged.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from egs_warp.deformation.deformer import Deformer
from egs_warp.deformation.embedding import embed_gaussians
from egs_warp.deformation.splitting import split_for_motion
from egs_warp.errors import UserError
from egs_warp.geometry.camera import Camera
from egs_warp.geometry.gaussians import MAX_LOG_SCALE, MAX_VALUE, GaussianCloud, unit_quaternions
from egs_warp.render import render_gaussians
from tests.support.deformation_scenes import bent, box
from tests.support.properties import examples

torch = pytest.importorskip("torch")
from egs_warp.render.autograd import render_torch  # noqa: E402
from egs_warp.training.finetune import FinetuneOptions, finetune, render_views  # noqa: E402

COUNT, ODD = 40, 7
NAMES = ("means", "rotations", "log_scales", "opacity_logits", "sh")
MIDDLE, UP = np.array([0.5, 0.5, 0.5]), np.array([0.0, -1.0, 0.0])
CAMERA = Camera.look_at(np.array([0.5, 0.5, -2.5]), MIDDLE, UP, width=48, height=40)
CAGE = box((8, 2, 2), (1.0, 1.0, 1.0))
MOTIONS = (CAGE.nodes, bent(CAGE.nodes, 0.7), CAGE.nodes * [1.0, 1.0, -1.0], CAGE.nodes * [1.0, 1.0, 0.0])

magnitudes = st.sampled_from([0.0, 1e-45, 1e-40, 1e-30, 1e-20, 1.0, 1e3, 1e6, 1e12, 0.99 * MAX_VALUE])
numbers = st.builds(lambda size, sign: sign * size, magnitudes, st.sampled_from([-1.0, 1.0]))
log_scales = st.sampled_from([-0.99 * MAX_VALUE, -1e3, -104.0, -88.0, -45.0, -20.0, 0.0, 5.0, 20.0, MAX_LOG_SCALE])


@st.composite
def changes(draw: st.DrawFn) -> dict[str, tuple[int, float]]:
    """Draw changes of one or two attributes of the extreme Gaussian: for each, the number of changed components and
    their value."""
    names = draw(st.sets(st.sampled_from(NAMES), min_size=1, max_size=2))
    chosen = {name: log_scales if name == "log_scales" else numbers for name in NAMES}
    return {name: (draw(st.integers(1, 4)), draw(chosen[name])) for name in sorted(names)}


def odd(changed: dict[str, tuple[int, float]]) -> dict[str, np.ndarray]:
    """Return an ordinary cloud in which one Gaussian has the values ``changed``."""
    values = ordinary()
    for name, (count, value) in changed.items():
        values[name].reshape(COUNT, -1)[ODD, :count] = value
    return values


def ordinary() -> dict[str, np.ndarray]:
    random = np.random.default_rng(0)
    return {
        "means": random.uniform(0.1, 0.9, (COUNT, 3)),
        "rotations": random.normal(size=(COUNT, 4)),
        "log_scales": random.uniform(-4.0, -2.0, (COUNT, 3)),
        "opacity_logits": random.normal(size=COUNT),
        "sh": 0.3 * random.normal(size=(COUNT, 16, 3)),
    }


def cloud_of(values: dict[str, Any]) -> GaussianCloud:
    return GaussianCloud.from_numpy(**values, device="cpu")


def arrays(cloud: GaussianCloud) -> dict[str, np.ndarray]:
    return {name: getattr(cloud, name).numpy() for name in NAMES}


def assert_finite(values: dict[str, Any]) -> None:
    assert not [name for name, value in values.items() if not np.isfinite(value).all()]


def tried(law: Any) -> Any:
    """Decorate the property ``law`` so that it is tested with 40 cases in ``make test``."""
    profile = settings(max_examples=examples(40), phases=[Phase.generate])
    return profile(given(changed=changes())(law))


@tried
def test_pictures_are_finite_and_a_clear_gaussian_leaves_no_trace(changed: dict[str, tuple[int, float]]) -> None:
    values = odd(changed)
    image = render_gaussians(cloud_of(values), CAMERA)
    assert_finite({"colour": image.colour.numpy(), "alpha": image.alpha.numpy(), "depth": image.depth.numpy()})
    assert image.alpha.numpy().min() >= 0.0 and image.alpha.numpy().max() <= 1.0
    values["opacity_logits"][ODD] = -100.0
    rest = cloud_of({name: np.delete(value, ODD, axis=0) for name, value in values.items()})
    for name in ("colour", "alpha", "depth"):
        clear = getattr(render_gaussians(cloud_of(values), CAMERA), name).numpy()
        np.testing.assert_array_equal(clear, getattr(render_gaussians(rest, CAMERA), name).numpy())


@tried
def test_gradients_are_finite(changed: dict[str, tuple[int, float]]) -> None:
    tensors = {name: torch.tensor(value, requires_grad=True) for name, value in arrays(cloud_of(odd(changed))).items()}
    image = render_torch(*tensors.values(), camera=CAMERA)
    (image.colour.mean() + image.alpha.mean() + 1e-30 * image.depth.mean()).backward()
    assert_finite({name: tensor.grad.numpy() for name, tensor in tensors.items()})


@tried
def test_a_cage_deforms_it_and_leaves_all_others_unchanged(changed: dict[str, tuple[int, float]]) -> None:
    """Eq. (14) to (17): an extreme Gaussian is harmless in moved, bent, inverted and flattened cages, with splits where
    Gaussians bend."""
    cloud, usual = cloud_of(odd(changed)), cloud_of(ordinary())
    others = np.arange(COUNT) != ODD
    carriers = [Deformer(one, embed_gaussians(one, CAGE)) for one in (cloud, usual)]
    for motion in MOTIONS:
        got, expected = (arrays(carrier.deform(motion).cloud) for carrier in carriers)
        assert_finite(got)
        assert all((got[name][others] == expected[name][others]).all() for name in NAMES)
    splits = [
        split_for_motion(one, embed_gaussians(one, CAGE), MOTIONS[:2], max_growth=100.0) for one in (cloud, usual)
    ]
    kept = [split.parents != ODD for split in splits]
    for name, value in arrays(splits[0].cloud).items():
        assert np.isfinite(value).all()
        np.testing.assert_array_equal(value[kept[0]], arrays(splits[1].cloud)[name][kept[1]])


@settings(max_examples=examples(15), phases=[Phase.generate])
@given(changed=changes())
def test_training_stays_finite_or_reports_the_reason(changed: dict[str, tuple[int, float]]) -> None:
    views = render_views(cloud_of(ordinary()), [CAMERA])
    try:
        result = finetune(cloud_of(odd(changed)), views, options=FinetuneOptions(iterations=3))
    except UserError as error:
        assert "not finite" in str(error)
        return
    assert_finite(arrays(result.cloud))


@pytest.mark.parametrize("name", [name for name in NAMES if name != "rotations"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e19, -1e19, 1e39, 1e300])
def test_numbers_that_single_precision_cannot_square_are_refused(name: str, value: float) -> None:
    values = odd({name: (1, value)})
    if name == "log_scales" and value == -1e19:
        assert_finite(arrays(cloud_of(values)))
        return
    problem = "is too large for single precision" if np.isfinite(value) else "is not finite"
    with pytest.raises(UserError, match=rf"^capture: {name} of 1 Gaussians {problem} \(first: number 7\); remove them"):
        cloud_of(values)


@pytest.mark.parametrize("size", [1e-320, 1e-200, 1e-40, 1e-10, 1.0, 1e10, 1e200, 1e300])
def test_only_the_direction_of_a_quaternion_counts(size: float) -> None:
    """Quaternions of any length are normalised, and a quaternion of length 0 becomes the identity."""
    along = np.array([[0.6, -0.0, 0.0, 0.8], [-0.5, 0.5, 0.5, 0.5], [0.0, 0.0, 0.0, 0.0]])
    expected = np.array([along[0], along[1], [1.0, 0.0, 0.0, 0.0]])
    np.testing.assert_allclose(unit_quaternions(size * along), expected, atol=1e-3 if size < 1e-300 else 1e-7)
