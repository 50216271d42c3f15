"""The settings of RIVR's candidates, of the choice between them, and of the frames that are repaired."""

from __future__ import annotations

from pydantic import Field, field_validator

from cleargs.base_model import FrozenModel
from cleargs.plugins import require_known
from cleargs.rivr.candidates import ALWAYS, CANDIDATES
from cleargs.rivr.gates import GateConfig


class RepairConfig(FrozenModel):
    """Settings of the repair of one frame."""

    margin: float = Field(
        1.0, ge=0.0, le=100.0, description="primary scores this close to the best go to the tie-break scorer"
    )
    keep_raw: bool = Field(
        True,
        description="a frame image that needs no repair is trained on as filmed; false: every target frame "
        "gets a pseudo observation, as in the paper",
    )
    fuse_sigma: float = Field(
        2.0, gt=0.0, le=100.0, description="Gaussian that splits detail from base in the fusion, px"
    )
    use_observation: bool = Field(
        True, description="false: the ablation whose expert restores the render instead of the frame image"
    )
    undo_motion: bool = Field(
        True,
        description="with use_observation: undo the blur and the skew of the camera's motion in the frame "
        "image before the expert restores it; false: the expert restores the frame image, as in the paper",
    )
    candidates: tuple[str, ...] = Field(
        (),
        description="candidates in addition to the render and the restored frame: fused (the render with the "
        "detail of the restored frame, as in the paper), or one of another package. With undo_motion the "
        "restored frame already has the render's detail; the fusion has it twice",
        json_schema_extra={"plugin": "candidates"},
    )
    gate: GateConfig = Field(GateConfig(), description="limits beyond which a repair is refused")

    @field_validator("candidates")
    @classmethod
    def _names_candidates(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        others = [name for name in CANDIDATES if name not in ALWAYS]
        return tuple(require_known("candidates", name, others) for name in names)
