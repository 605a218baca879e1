from __future__ import annotations

import weakref

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import oracles_loss
from tests.published import published_values
from zsdata.losses import photometric_loss, sequence_weights, window_means, zero_stereo_loss
from zsdata.sample import Masks
from zsdata.synthesis.backward_warp import backward_warp


def random_case(seed: int, patterns: tuple[str, str, str] = ("random",) * 3, batch: int = 2, size: tuple[int, int] = (5, 8), n: int = 3):
    """Everything zero_stereo_loss takes, with labels that are not finite wherever the valid mask is False."""
    rng = np.random.default_rng(seed)
    shape = (batch, 1, *size)

    def mask(pattern: str) -> torch.Tensor:
        share = {"all": 1.0, "none": 0.0, "random": 0.5, "one": 0.0}[pattern]
        values = rng.random(shape) < share
        if pattern == "one":
            values.flat[rng.integers(values.size)] = True
        return torch.from_numpy(values)

    masks = Masks(*map(mask, patterns))
    # Whole 64ths, so that single and double precision round x - d to the same column, ties included.
    disparity = torch.from_numpy(rng.integers(8, 400, shape).astype(np.float32) / 64)
    nothing = torch.from_numpy(rng.choice([np.nan, np.inf, -np.inf], shape).astype(np.float32))
    images = [torch.from_numpy(rng.uniform(0, 255, (batch, 3, *size)).astype(np.float32)) for _ in range(2)]
    predictions = [torch.from_numpy(rng.uniform(-2, 10, shape).astype(np.float32)).requires_grad_() for _ in range(n + 1)]
    return {
        "predictions": predictions[:n],
        "left_clean": images[0],
        "right_clean": images[1],
        "disparity": torch.where(masks.valid, disparity, nothing),
        "confidence": torch.from_numpy(rng.random(shape).astype(np.float32)),
        "masks": masks,
        "initial_prediction": predictions[n],
    }


def oracle(case: dict, gamma: float = 0.9, mu: float = 0.1, beta: float = 0.85, max_disparity: float = 700) -> float:
    def flat(tensor: torch.Tensor) -> np.ndarray:
        return tensor.detach().double().numpy()[:, 0] if tensor.dtype != torch.bool else tensor.numpy()[:, 0]

    initial = case["initial_prediction"]
    return oracles_loss.zero_stereo_loss(
        [flat(prediction) for prediction in case["predictions"]],
        case["left_clean"].double().numpy(),
        case["right_clean"].double().numpy(),
        *(flat(map_) for map_ in (case["disparity"], case["confidence"], *case["masks"])),
        None if initial is None else flat(initial),
        gamma,
        mu,
        beta,
        max_disparity,
    )


PATTERNS = st.sampled_from(["all", "none", "random", "one"])


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    patterns=st.tuples(PATTERNS, PATTERNS, PATTERNS),
    n=st.integers(1, 3),
    initial=st.booleans(),
    gamma=st.sampled_from([0.8, 0.9, 1.0]),
    mu=st.sampled_from([0.0, 0.1, 2.0]),
    beta=st.sampled_from([0.0, 0.85, 1.0]),
    max_disparity=st.sampled_from([3.0, 700.0]),
)
def test_the_loss_is_the_papers_for_every_mask_and_its_gradient_is_finite(seed, patterns, n, initial, gamma, mu, beta, max_disparity):
    case = random_case(seed, patterns, batch=1, n=n)
    if not initial:
        case["initial_prediction"] = None
    options = {"gamma": gamma, "mu": mu, "beta": beta, "max_disparity": max_disparity}
    loss, metrics = zero_stereo_loss(**case, **options)
    assert loss.item() == pytest.approx(oracle(case, **options), rel=1e-4, abs=1e-5)
    assert all(torch.isfinite(value) for value in metrics.values())
    loss.backward()
    for prediction in [*case["predictions"], *([case["initial_prediction"]] if initial else [])]:
        assert torch.isfinite(prediction.grad).all()


def test_the_loss_of_a_batch_is_the_papers():
    case = random_case(7, batch=2)
    loss, _ = zero_stereo_loss(**case)
    assert loss.item() == pytest.approx(oracle(case), rel=1e-5)


@pytest.fixture(scope="module")
def published():
    values = published_values("loss")
    case = {
        "predictions": list(values["predictions"]),
        "left_clean": values["left"] * 255,
        "right_clean": values["right"] * 255,
        "disparity": values["disparity"],
        "confidence": values["confidence"],
        "masks": Masks(values["nonocclusion"], values["inpaint"], values["valid"]),
    }
    return values, case


def test_the_published_loss_is_reproduced(published):
    values, case = published
    loss, metrics = zero_stereo_loss(**case)
    assert loss.item() == pytest.approx(values["loss_sequence"].item(), abs=1e-5)
    assert metrics["epe"].item() == pytest.approx(values["epe"].item(), abs=1e-5)


def test_the_published_loss_with_an_initial_prediction_is_reproduced(published):
    values, case = published
    loss, metrics = zero_stereo_loss(**case, initial_prediction=values["initial"])
    assert loss.item() == pytest.approx(values["loss_with_initial"].item(), abs=1e-5)
    assert metrics["initial_term"].item() == pytest.approx((values["loss_with_initial"] - values["loss_sequence"]).item(), abs=1e-5)


def test_the_published_photometric_map_is_reproduced(published):
    values, _ = published
    photometric = photometric_loss(values["left"], backward_warp(values["right"], values["disparity"]))
    exact = photometric_loss(values["left"].double(), backward_warp(values["right"].double(), values["disparity"].double()))
    torch.testing.assert_close(photometric, exact.float(), atol=1e-5, rtol=0)
    torch.testing.assert_close(photometric, values["photometric"], atol=2e-5, rtol=0)  # which is 1.9e-5 off in float32 itself


def test_sequence_weights_start_at_gamma_to_the_15th_and_end_at_one():
    assert sequence_weights(1, 0.9) == [1.0]
    for count in (2, 16, 22):
        weights = sequence_weights(count, 0.9)
        assert weights[0] == pytest.approx(0.9**15) and weights[-1] == 1.0
        assert weights == sorted(weights)


def test_each_mask_decides_where_a_prediction_is_pulled():
    """The gradient reaches exactly the supervised pixels through the label, and no hidden or invented pixel through the photograph."""
    case = random_case(3)
    case["initial_prediction"] = None
    loss, _ = zero_stereo_loss(**case, mu=0.0)
    loss.backward()
    assert torch.equal(case["predictions"][-1].grad != 0, case["masks"].valid)

    nothing_known = random_case(3, ("random", "all", "none"))
    loss, metrics = zero_stereo_loss(**nothing_known)
    loss.backward()
    assert loss.item() == 0 and metrics["photometric_term"] == 0
    assert all((prediction.grad == 0).all() for prediction in nothing_known["predictions"])


def test_labels_at_the_limit_do_not_supervise():
    case = random_case(5, ("none", "none", "all"))
    case["disparity"][0, 0, 0, 0] = 700.0
    case["disparity"][0, 0, 0, 1] = 699.0
    loss, _ = zero_stereo_loss(**case)
    loss.backward()
    grad = case["predictions"][-1].grad[0, 0, 0]
    assert grad[0] == 0 and grad[1] != 0


def test_metrics_are_of_the_last_prediction_over_valid_pixels():
    shape = (1, 1, 8, 8)
    valid = torch.ones(shape, dtype=torch.bool)
    valid[..., 4:] = False
    disparity = torch.full(shape, 5.0)
    last = torch.full(shape, 5.0)
    last[..., 0] += 2  # an eighth of the picture, a quarter of what is valid
    last[..., 1] -= 4
    last[..., 2] += 1  # not bad: "bad-1" is off by more than 1 px
    last[..., 4:] = 100.0
    images = torch.zeros(1, 3, 8, 8)
    masks = Masks(valid, ~valid, valid)
    _, metrics = zero_stereo_loss([last + 50, last], images, images, disparity, torch.ones(shape), masks)
    assert metrics["epe"].item() == pytest.approx(1.75)
    assert metrics["bad_1"].item() == pytest.approx(0.5) and metrics["bad_3"].item() == pytest.approx(0.25)
    assert not any(value.requires_grad for value in metrics.values())


def test_no_photometric_term_is_computed_when_mu_is_zero(monkeypatch):
    monkeypatch.setattr("zsdata.losses._photometric_loss", lambda *_: pytest.fail("computed"))
    zero_stereo_loss(**random_case(1), mu=0.0)


def plain_loss(case: dict, mu: float, beta: float) -> torch.Tensor:
    """The loss with an ordinary SSIM, left to autograd; without an initial prediction, every label valid."""
    masks = case["masks"]
    weights = sequence_weights(len(case["predictions"]), 0.9)
    left, right = case["left_clean"].double() / 255, case["right_clean"].double() / 255
    known = backward_warp((~masks.inpaint).double(), case["disparity"], mode="nearest", padding="zeros") > 0
    judged = (masks.nonocclusion & known).double()

    def window_mean(image: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.avg_pool2d(torch.nn.functional.pad(image, (3, 3, 3, 3), mode="reflect"), 7, stride=1)

    total = left.new_zeros(())
    for weight, prediction in zip(weights, case["predictions"], strict=True):
        seen = backward_warp(right, prediction.double())
        a, b = window_mean(left), window_mean(seen)
        variances = window_mean(left**2) - a**2 + window_mean(seen**2) - b**2
        covariance = window_mean(left * seen) - a * b
        ssim = (2 * a * b + 0.01**2) * (2 * covariance + 0.03**2) / ((a**2 + b**2 + 0.01**2) * (variances + 0.03**2))
        photometric = (beta * ((1 - ssim) / 2).clamp(0, 1) + (1 - beta) * (left - seen).abs()).mean(1, keepdim=True)
        disparity_term = (case["confidence"] * (prediction - case["disparity"]).abs()).mean()
        total = total + weight * (disparity_term + mu * ((1 - case["confidence"]) * photometric * judged).sum() / judged.sum())
    return total


def test_the_gradient_found_at_once_is_that_of_autograd():
    case = random_case(11, ("random", "random", "all"), size=(12, 17))
    case["initial_prediction"] = None
    gradients = []
    for loss in (3 * zero_stereo_loss(**case, mu=2.0, beta=0.7)[0], 3 * plain_loss(case, mu=2.0, beta=0.7)):
        for prediction in case["predictions"]:
            prediction.grad = None
        loss.backward()
        gradients.append(torch.stack([prediction.grad for prediction in case["predictions"]]))
    assert gradients[1].abs().max() > 1e-3
    torch.testing.assert_close(gradients[0], gradients[1], atol=1e-6, rtol=1e-4)


def test_window_means_are_those_of_a_pooling_with_its_gradient():
    image = torch.rand(2, 3, 9, 4, dtype=torch.float64, requires_grad=True)
    pooled = torch.nn.functional.avg_pool2d(torch.nn.functional.pad(image, (3, 3, 3, 3), mode="reflect"), 7, stride=1)
    torch.testing.assert_close(window_means(image), pooled)
    assert torch.autograd.gradcheck(window_means, image)


class Saved:
    def __init__(self, tensor: torch.Tensor) -> None:
        self.tensor = tensor


def test_the_backward_pass_keeps_no_image_per_prediction():
    case = random_case(9, size=(16, 16), n=12)
    alive: weakref.WeakSet[Saved] = weakref.WeakSet()

    def save(tensor: torch.Tensor) -> Saved:
        saved = Saved(tensor)
        alive.add(saved)
        return saved

    with torch.autograd.graph.saved_tensors_hooks(save, lambda saved: saved.tensor):
        loss, _ = zero_stereo_loss(**case)
    kept = {saved.tensor.data_ptr(): saved.tensor.numel() for saved in alive}
    assert loss.requires_grad and 0 < sum(kept.values()) / case["disparity"].numel() < 4 * 13  # an SSIM alone is made of some 50 maps


def test_the_ordinary_photometric_term_counts_every_pixel_alike():
    case = random_case(8, ("none", "all", "none"), size=(6, 9))
    for confidence in (0.0, 0.7):
        _, metrics = zero_stereo_loss(**{**case, "confidence": torch.full_like(case["confidence"], confidence)}, photometric="ordinary")
        maps = [
            oracles_loss.photometric_loss(left.double().numpy() / 255, right.double().numpy() / 255, prediction.detach().numpy(), 0.85)
            for left, right, prediction in zip(case["left_clean"], case["right_clean"], case["predictions"][-1][:, 0], strict=True)
        ]
        assert metrics["photometric_term"].item() == pytest.approx(0.1 * np.mean(maps), rel=1e-4)


@pytest.mark.parametrize("photometric", ["nonocclusion", "ordinary"])
def test_two_ranks_together_have_the_loss_of_their_pairs_in_one_batch(photometric):
    case = random_case(13, batch=4, size=(8, 9))
    case["masks"].valid[:2] = False  # one rank has nothing to supervise
    options = {"photometric": photometric, "max_disparity": 5.0}

    def gradient_and_values(batch: dict, **more):
        for prediction in batch["predictions"]:
            prediction.grad = None
        loss, metrics = zero_stereo_loss(**batch, **options, **more)
        loss.backward()
        return torch.stack([prediction.grad for prediction in batch["predictions"]]), {"loss": loss.detach(), **metrics}

    def rank(first: int) -> dict:
        return {
            "predictions": [prediction.detach()[first : first + 2].requires_grad_() for prediction in case["predictions"]],
            "masks": Masks(*(mask[first : first + 2] for mask in case["masks"])),
            "initial_prediction": case["initial_prediction"].detach()[first : first + 2],
            **{name: case[name][first : first + 2] for name in ("left_clean", "right_clean", "disparity", "confidence")},
        }

    counts = []
    for first in (0, 2):
        zero_stereo_loss(**rank(first), **options, mean_over_ranks=lambda values: counts.append(values) or values)
    shared = torch.stack(counts).mean(0)
    ranks = [gradient_and_values(rank(first), mean_over_ranks=lambda values: shared) for first in (0, 2)]
    gradients, whole = gradient_and_values(case)
    torch.testing.assert_close(torch.cat([gradient for gradient, _ in ranks], dim=1) / 2, gradients, atol=1e-7, rtol=1e-5)
    for name, value in whole.items():
        torch.testing.assert_close((ranks[0][1][name] + ranks[1][1][name]) / 2, value)


def test_half_precision_predictions_are_judged_in_full_precision():
    case = random_case(2)
    case["initial_prediction"] = None
    half = [prediction.detach().half() for prediction in case["predictions"]]
    loss, _ = zero_stereo_loss(**{**case, "predictions": half})
    expected, _ = zero_stereo_loss(**{**case, "predictions": [prediction.float() for prediction in half]})
    assert loss.dtype == torch.float32 and torch.equal(loss, expected)


def test_a_confidence_that_is_not_finite_is_harmless_where_the_label_is_invalid():
    case = random_case(6)
    case["disparity"] = torch.full_like(case["disparity"], 2.0)
    case["confidence"] = torch.where(case["masks"].valid, case["confidence"], torch.nan)
    loss, _ = zero_stereo_loss(**case)
    case["confidence"] = case["confidence"].nan_to_num(0.0)
    assert torch.equal(loss, zero_stereo_loss(**case)[0])


def test_arguments_are_left_as_they_were():
    case = random_case(4)
    before = [case[name].clone() for name in ("left_clean", "right_clean", "disparity", "confidence")]
    zero_stereo_loss(**case)[0].backward()
    for name, copy in zip(("left_clean", "right_clean", "disparity", "confidence"), before, strict=True):
        assert torch.equal(case[name].nan_to_num(), copy.nan_to_num())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda case: case.update(predictions=[]), "one or more"),
        (lambda case: case.update(predictions=case["predictions"][0]), "list"),
        (lambda case: case.update(disparity=case["disparity"][:, 0]), r"disparity is \[B, 1, H, W\]"),
        (lambda case: case["predictions"].append(torch.zeros(2, 1, 5, 9)), r"predictions\[3\].*\[2, 1, 5, 9\]"),
        (lambda case: case.update(confidence=torch.zeros(2, 3, 5, 8)), "confidence"),
        (lambda case: case.update(left_clean=torch.zeros(2, 1, 5, 8)), "left_clean"),
        (lambda case: case.update(right_clean=torch.zeros(2, 3, 5, 9)), "right_clean"),
        (lambda case: case.update(masks=Masks(*(mask[:1] for mask in case["masks"]))), "masks.nonocclusion"),
        (lambda case: case.update(initial_prediction=torch.zeros(1, 1, 5, 8)), "initial_prediction"),
        (lambda case: case.update(gamma=0.0), "gamma"),
        (lambda case: case.update(mu=-1.0), "mu"),
        (lambda case: case.update(beta=1.5), "beta"),
        (lambda case: case.update(photometric="none"), "nonocclusion, ordinary; got 'none'"),
    ],
)
def test_what_does_not_fit_is_named(change, message):
    case = random_case(0)
    change(case)
    with pytest.raises(ValueError, match=message):
        zero_stereo_loss(**case)


def test_a_mask_of_numbers_is_refused():
    case = random_case(0)
    case["masks"] = Masks(*(mask.float() for mask in case["masks"]))
    with pytest.raises(TypeError, match=r"masks\.nonocclusion is bool"):
        zero_stereo_loss(**case)
