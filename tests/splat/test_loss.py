"""Loss, metrics, Adam and exposure against independent torch implementations in float64."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F  # noqa: N812  # torch's own name for it
from helpers.losses import adam_step, photometric_loss

from cleargs.splat.backend import backend_for, psnr
from cleargs.splat.formation import clip_to_saturation
from cleargs.splat.gaussians import Gaussians
from cleargs.splat.types import Moments, Rates


def images(height: int, width: int, device: torch.device | str = "cpu"):
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(height, width, 3, generator=generator)
    image = (target + 0.2 * torch.randn(height, width, 3, generator=generator)).clamp(0, 1)
    return image.to(device), target.to(device), generator


def ssim_map(image, target):
    """SSIM by a full 11 x 11 convolution with zero padding, [H, W, 3]."""
    window = torch.exp(-((torch.arange(11, dtype=image.dtype, device=image.device) - 5) ** 2) / (2 * 1.5**2))
    window = window / window.sum()
    kernel = (window[:, None] * window[None])[None, None].expand(3, 1, 11, 11)

    def mean(x):
        padded = x.permute(2, 0, 1)[None]
        return F.conv2d(padded, kernel, padding=5, groups=3)[0].permute(1, 2, 0)

    m, n = mean(image), mean(target)
    variances = mean(image**2) - m**2 + mean(target**2) - n**2
    covariance = mean(image * target) - m * n
    return ((2 * m * n + 0.01**2) * (2 * covariance + 0.03**2)) / (
        (m**2 + n**2 + 0.01**2) * (variances + 0.03**2)
    )


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("size", [(12, 43), (1, 1), (3, 43), (13, 2)])
def test_photometric_loss_equals_torch(size, masked, device):
    image, target, generator = images(*size, device)
    mask = (torch.rand(size, generator=generator) > 0.3).to(device) if masked else None
    if mask is not None:
        mask[0, 0] = True
    result = photometric_loss(image, target, ssim_lambda=0.2, weight=0.7, mask=mask)

    x, y = image.double().requires_grad_(), target.double()
    kept = x.new_ones(*size, 1) if mask is None else mask[..., None].double()
    count = 3 * kept.sum()
    l1 = ((x - y).abs() * kept).sum() / count
    similarity = (ssim_map(x * kept, y * kept) * kept).sum() / count
    loss = 0.7 * (0.8 * l1 + 0.2 * (1 - similarity))
    loss.backward()
    # The tolerances of the CPU kernels: variances are differences of float32 means, 6e-8 against C2 = 9e-4.
    assert result.loss == pytest.approx(loss.item(), abs=1e-6)
    assert result.l1 == pytest.approx(l1.item(), abs=1e-7)
    assert result.ssim == pytest.approx(similarity.item(), abs=1e-6)
    assert (result.grad_image - x.grad).abs().max() < 3e-6 * x.grad.abs().max()
    error = ((x - y) ** 2 * kept).sum() / count
    assert psnr(image, target, mask) == pytest.approx(-10 * math.log10(error.item()), abs=1e-9)
    if mask is not None:
        assert not result.grad_image[~mask].any()


def test_flat_images_keep_their_precision():
    """Constant patches are the worst case of E[x²] - E[x]²: 6e-8 against C2 = 9e-4, amplified in the border.

    The measured error is 6e-3 of this gradient, whose largest entry is a seventh of the gradient of L1.
    """
    image, target = torch.full((40, 40, 3), 0.9), torch.full((40, 40, 3), 0.85)
    x = image.double().requires_grad_()
    similarity = ssim_map(x, target.double()).mean()
    similarity.backward()
    result = photometric_loss(image, target, ssim_lambda=1.0)
    assert result.ssim == pytest.approx(similarity.item(), abs=2e-4)
    assert (result.grad_image + x.grad).abs().max() < 1.5e-2 * x.grad.abs().max()


def test_the_weight_scales_loss_and_gradient():
    image, target, _ = images(20, 30)
    plain = photometric_loss(image, target, ssim_lambda=0.2)
    weighted = photometric_loss(image, target, ssim_lambda=0.2, weight=1.0)
    assert plain.loss == weighted.loss == (1.0 - 0.2) * plain.l1 + 0.2 * (1.0 - plain.ssim)
    assert torch.equal(plain.grad_image, weighted.grad_image)
    absolute = photometric_loss(image, target, ssim_lambda=0.0, weight=1.0)
    assert torch.equal(absolute.grad_image, (image - target).sign() * torch.tensor(1.0 / 1800))
    nothing = photometric_loss(image, target, ssim_lambda=0.2, weight=0.0)
    assert nothing.loss == 0.0
    assert not nothing.grad_image.any()
    doubled = photometric_loss(image, target, ssim_lambda=0.2, weight=2.0)
    assert doubled.loss == 2 * plain.loss


def test_masks():
    image, target, _ = images(20, 30)
    everything = torch.ones(20, 30, dtype=torch.bool)
    plain = photometric_loss(image, target, ssim_lambda=0.2)
    kept = photometric_loss(image, target, ssim_lambda=0.2, mask=everything)
    assert (plain.loss, plain.l1, plain.ssim) == (kept.loss, kept.l1, kept.ssim)
    assert torch.equal(plain.grad_image, kept.grad_image)
    nothing = photometric_loss(image, target, ssim_lambda=0.2, mask=~everything)
    assert nothing.loss == 0.0
    assert not nothing.grad_image.any()
    # Masked pixels have no influence.
    mask = everything.clone()
    mask[5:9, 3:20] = False
    changed = torch.where(mask[..., None], target, torch.zeros(()))
    before = photometric_loss(image, target, ssim_lambda=0.2, mask=mask)
    after = photometric_loss(image, changed, ssim_lambda=0.2, mask=mask)
    assert before.loss == after.loss
    assert psnr(image, target, mask) == psnr(image, changed, mask)


def test_equal_images():
    image, _, _ = images(20, 30)
    result = photometric_loss(image, image, ssim_lambda=0.2)
    assert result.ssim == pytest.approx(1.0, abs=1e-6)
    assert result.loss == pytest.approx(0.0, abs=1e-6)
    assert psnr(image, image) == math.inf


def test_psnr():
    image, target, generator = images(20, 30)
    mask = torch.rand(20, 30, generator=generator) > 0.5
    error = (image.double() - target.double()) ** 2
    assert psnr(image, target) == pytest.approx(-10 * math.log10(error.mean().item()), abs=1e-9)
    assert psnr(image, target, mask) == pytest.approx(-10 * math.log10(error[mask].mean().item()), abs=1e-9)


def test_psnr_refuses_images_that_do_not_match():
    image, target, _ = images(8, 9)
    for other, mask in ((target[:5], None), (target, torch.ones(9, 8, dtype=torch.bool))):
        with pytest.raises(ValueError, match="differ"):
            psnr(image, other, mask)


def drawn(count: int, coefficients: int, generator: torch.Generator) -> Gaussians:
    """Return parameters of normal random numbers."""
    shapes = ((count, 3), (count, 3), (count, 4), (count,), (count, coefficients, 3))
    return Gaussians(*(torch.randn(shape, generator=generator) for shape in shapes))


def by_rate(gaussians: Gaussians) -> dict[str, torch.Tensor]:
    """Return the tensors with a learning rate each, by its name."""
    tensors = gaussians.tensors()
    return {**tensors, "sh": tensors["sh"][:, :1], "sh_rest": tensors["sh"][:, 1:]}


@pytest.mark.parametrize(("count", "coefficients"), [(1100, 16), (9, 1), (1, 4)])
def test_adam_equals_torch(count, coefficients, device):
    generator = torch.Generator().manual_seed(0)
    start = drawn(count, coefficients, generator)
    mine, moments = start.clone().to(device), Moments.zeros(start.to(device))
    rates = Rates(0.01, 0.008, 0.006, 0.004, 0.01, 0.002)
    theirs = {name: tensor.double().requires_grad_() for name, tensor in by_rate(start).items()}
    groups = [{"params": [tensor], "lr": getattr(rates, name)} for name, tensor in theirs.items()]
    optimiser = torch.optim.Adam(groups, betas=(0.9, 0.999), eps=1e-15)
    for step in range(1, 5):
        gradients = drawn(count, coefficients, generator)
        for name, gradient in by_rate(gradients).items():
            gradient[0] = 0.0
            theirs[name].grad = gradient.double()
        optimiser.step()
        adam_step(mine, gradients.to(device), moments, step, rates)
    for name, tensor in by_rate(mine.to("cpu")).items():
        assert ((tensor - theirs[name]).abs() < 2e-6).all(), name
        assert torch.equal(tensor[0], by_rate(start)[name][0]), name


def test_the_regularisers_equal_autograd(device):
    """The first moment after a step is a tenth of the gradient."""
    generator = torch.Generator().manual_seed(0)
    start, gradients = drawn(300, 4, generator), drawn(300, 4, generator)
    opacities, scales = (
        tensor.double().requires_grad_() for tensor in (start.logit_opacities, start.log_scales)
    )
    (0.3 * opacities.sigmoid().mean() + 0.2 * scales.exp().mean()).backward()
    expected = gradients.clone().tensors()
    expected["logit_opacities"] = expected["logit_opacities"] + opacities.grad
    expected["log_scales"] = expected["log_scales"] + scales.grad
    moments = Moments.zeros(start.to(device))
    backend_for(device).step_gaussians(
        *(start.to(device), gradients.to(device), moments, Rates(*[0.0] * 6)), step=1, opacity=0.3, scale=0.2
    )
    for name, first in moments.first.items():
        torch.testing.assert_close(first.cpu().double(), 0.1 * expected[name].double(), rtol=1e-5, atol=1e-8)


def test_a_brighter_value_than_a_saturated_one_counts_as_equal(device):
    image, target, generator = images(6, 43, device)
    mask = (torch.rand(6, 43, generator=generator) > 0.3).to(device)
    recorded, too_bright = clip_to_saturation(image, target, 0.7)
    assert 0.05 < too_bright.double().mean() < 0.5
    expected = photometric_loss(recorded, target, ssim_lambda=0.2, mask=mask)
    found = photometric_loss(image, target, ssim_lambda=0.2, mask=mask, saturated=0.7)
    assert (found.loss, found.l1, found.ssim) == (expected.loss, expected.l1, expected.ssim)
    assert torch.equal(found.grad_image, expected.grad_image.masked_fill(too_bright, 0.0))


def test_exposure_equals_autograd(device):
    image, upstream, generator = images(14, 19, device)
    affine = torch.eye(3, 4) + 0.1 * torch.randn(3, 4, generator=generator)
    x, a = image.double().requires_grad_(), affine.double().to(device).requires_grad_()
    output = torch.einsum("cs,hws->hwc", a[:, :3], x) + a[:, 3]
    (output * upstream).sum().backward()
    assert (backend_for(image.device).apply_affine(image, affine) - output).abs().max() < 1e-6
    grad_image, grad_affine = backend_for(image.device).affine_backward(image, affine, upstream)
    assert (grad_image - x.grad).abs().max() < 1e-6
    assert (grad_affine - a.grad).abs().max() < 1e-6 * a.grad.abs().max()


def test_weight_zero_and_nothing_kept(device):
    image, target, _ = images(14, 19, device)
    nothing = photometric_loss(image, target, ssim_lambda=0.2, weight=0.0)
    assert nothing.loss == 0.0
    assert not nothing.grad_image.any()
    hidden = torch.zeros(image.shape[:2], dtype=torch.bool, device=device)
    nothing = photometric_loss(image, target, ssim_lambda=0.2, mask=hidden)
    assert (nothing.loss, nothing.ssim) == (0.0, 1.0)
    assert not nothing.grad_image.any()
    assert psnr(image, image) == math.inf
