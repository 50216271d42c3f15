"""What a training asks of a densification strategy."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

    from cleargs.splat.adam import Moments
    from cleargs.splat.camera import Camera
    from cleargs.splat.engine import Engine
    from cleargs.splat.gaussians import Gaussians


class Strategy:
    """Changes the number and the places of the Gaussians. Another one overrides what it needs.

    Made with the settings of the training, the most Gaussians there may be, and the seed. Random numbers are
    drawn afresh from (seed, `Stream`, step), and what is remembered from step to step is in `state`: a
    resumed training is the same training. Steps count from 1, along the schedule.
    """

    def observe(self, engine: Engine, camera: Camera) -> None:
        """Called after every backward pass: ``engine`` knows the radii and gradients on the screen."""

    def wants_errors(self, step: int) -> bool:
        """Whether `add_errors` is to be called in this step, which costs it another backward pass."""
        return False

    def add_errors(self, errors: Tensor) -> None:
        """What each Gaussian contributes to squared errors of this step's frame: [N], at least 0.

        The sum over the pixels of the squared difference (times the frame's weight) times the Gaussian's
        share in the pixel.
        """

    def refine(self, gaussians: Gaussians, moments: Moments, step: int) -> tuple[Gaussians, Moments]:
        """Called every ``refine_interval`` steps between ``refine_start`` and ``refine_stop``.

        Returns the Gaussians to continue with and their moments. What is given may be changed, and must not
        be used again.
        """
        return gaussians, moments

    def after_step(self, gaussians: Gaussians, rate: float, step: int) -> None:
        """Called after every step and its refinement; may change the parameters in place. ``rate`` is the
        learning rate of the means."""

    def state(self) -> dict[str, Tensor]:
        """All that it remembers, for a checkpoint."""
        return {}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Resume from what `state` gave."""
