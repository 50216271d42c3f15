"""What the kernels on a GPU are held to against the float64 oracle."""

from __future__ import annotations

from splat_scenes import Comparison

# As for the CPU kernels, but 2^x is the device's ex2.approx (2 ulp) and sums over pixels have another order.
# In the interpreter the worst over the random scenes of test_gpu_rasteriser.py is 8e-7 in the image, 1.2e-6
# in the depth and 1.1e-6 of a gradient.
IMAGE_TOLERANCE = 3e-6
GRADIENT_TOLERANCE = 1e-5


def assert_close(
    result: Comparison, image: float = IMAGE_TOLERANCE, gradient: float = GRADIENT_TOLERANCE
) -> None:
    assert result.fragile < 0.05
    assert result.image < image
    assert result.depth < image
    for name, error in result.gradients.items():
        assert error < gradient, name
