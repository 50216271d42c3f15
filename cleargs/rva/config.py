"""Settings of RVA: the numbers of the paper's table tab:rva_params, and choices that it leaves open."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal
from urllib.parse import urlsplit

from pydantic import Field, field_validator, model_validator

from cleargs.base_model import FrozenModel, Unit
from cleargs.plugins import require_known

_SUM_TOLERANCE = 1e-9  # weights such as 0.30 + 0.25 + ... do not sum to exactly 1 in binary

Share = Annotated[float, Field(gt=0.0, le=1.0)]
"""A number above 0 and at most 1."""

EVALUATORS = ("statistics", "qwen3-vl")
"""Evaluators that ship with ClearGS."""

MODEL_VARIABLE = "CLEARGS_VLM_MODEL"
"""Environment variable with the model's name, used if ``qwen.model`` is empty."""

_NOT_IN_KEY = Field(json_schema_extra={"key": False})
"""Keeps a setting that does not change the scores out of the stage's key."""


class QwenConfig(FrozenModel):
    """Settings of the evaluator ``qwen3-vl``: a vision-language model on a server.

    The server's API key comes from the environment (CLEARGS_VLM_API_KEY) and is never written to a file.
    """

    model: str = Field(
        "",
        max_length=200,
        description=f"name of the model on the server; empty: from {MODEL_VARIABLE} in the environment",
    )
    base_url: Annotated[str, _NOT_IN_KEY] = Field(
        "",
        description="address of an OpenAI-compatible server (vLLM, llama.cpp, Ollama, LM Studio), including "
        "/v1; empty: from CLEARGS_VLM_URL in the environment, else http://127.0.0.1:8000/v1",
    )
    prompt: ClassVar[int] = 1
    """Version of the prompt; part of the evaluator's name in the table."""
    max_tokens: int = Field(1024, ge=64, le=32_768, description="maximum length of a reply, in tokens")
    concurrency: Annotated[int, _NOT_IN_KEY] = Field(
        4, ge=1, le=256, description="maximum number of requests at the same time"
    )
    timeout_s: Annotated[float, _NOT_IN_KEY] = Field(
        120.0, gt=0.0, le=3600.0, description="maximum wait for one reply"
    )


class EvaluatorConfig(FrozenModel):
    """Choice of the evaluator that scores the appearance of frames."""

    evaluator: str = Field(
        "statistics",
        json_schema_extra={"plugin": "evaluators"},
        description="evaluator of the appearance; statistics: image and video statistics, no network; "
        "qwen3-vl: the paper's vision-language model; or the name of a plugin",
    )
    qwen: QwenConfig = Field(QwenConfig(), description="settings of qwen3-vl")

    @field_validator("evaluator")
    @classmethod
    def _evaluator_is_known(cls, name: str) -> str:
        return require_known("evaluators", name, EVALUATORS)

    @model_validator(mode="before")
    @classmethod
    def _model_from_environment(cls, data: Any) -> Any:
        """Resolve the name of the model here, so that ``run.toml`` and the stage's key contain it."""
        if not isinstance(data, Mapping) or data.get("evaluator") != "qwen3-vl":
            return data
        qwen = data.get("qwen", {})
        if not isinstance(qwen, Mapping) or qwen.get("model"):
            return data
        return {**data, "qwen": {**qwen, "model": os.environ.get(MODEL_VARIABLE, "").strip()}}

    @model_validator(mode="after")
    def _model_is_known(self) -> EvaluatorConfig:
        if self.qwen.base_url:
            check_base_url(self.qwen.base_url)
        if self.evaluator == "qwen3-vl" and not self.qwen.model:
            raise ValueError(f"qwen3-vl needs qwen.model (or {MODEL_VARIABLE}), the model on the server")
        return self


class AssessmentConfig(FrozenModel):
    """All settings of RVA except those of the evaluator. Defaults are the paper's where it gives a value."""

    # Geometric evidence from poses and observations.
    frames_per_bin: int = Field(
        8, ge=1, le=10_000, description="mean number of registered frames per trajectory bin"
    )
    gamma_c: Unit = Field(0.65, description="weight of the camera-centre distance in a pose distance")
    gamma_v: Unit = Field(0.35, description="weight of the view angle in a pose distance")
    alpha: Unit = Field(0.45, description="weight of the coverage gain C in the geometric utility G")
    beta: Unit = Field(0.35, description="weight of the pose diversity D in G")
    eta: Unit = Field(0.30, description="weight of the visibility redundancy O, subtracted from G")

    # Scores from cues, and the reliable set.
    fallback_share: ClassVar[float] = 0.10
    """If no frame is reliable, this share of the registered frames (at least one; best by R - B) replaces the
    reliable set in the geometry."""
    w_R: tuple[Unit, Unit, Unit, Unit, Unit] = Field(
        (0.30, 0.25, 0.20, 0.15, 0.10),
        description="weights of sharpness, structure, texture, cleanness, exposure in R; they sum to 1",
    )
    w_B: tuple[Unit, Unit, Unit, Unit, Unit, Unit] = Field(
        (0.25, 0.15, 0.20, 0.15, 0.15, 0.10),
        description="weights of motion blur, defocus, ghosting, exposure failure, unreliable texture, "
        "artifacts in B; they sum to 1",
    )
    tau_R: Unit = Field(0.70, description="minimum R of a reliable (strong) frame")
    tau_B: Unit = Field(0.60, description="maximum B of a reliable (strong) frame")

    # Roles and weights from scores and geometry.
    enabled: bool = Field(
        True,
        description="false: the all-view ablation. All registered frames get weight 1 and the role strong; "
        "cues, scores and geometry are still computed and reported",
    )
    weighting: Literal["graded", "binary"] = Field(
        "graded",
        description="graded: the paper's roles and weights; binary: the baseline that drops blurry frames. "
        "The better frames by R - B get weight 1, the others 0, without coverage compensation",
    )
    binary_share: Share = Field(
        0.5,
        description="binary: this share of the registered frames (at least one) is kept, as well as all "
        "other reliable frames",
    )
    coverage: bool = Field(
        True, description="reactivate suppressed frames in trajectory bins without active frames"
    )
    active_share: Unit = Field(
        1.0,
        description="with coverage: suppressed frames are reactivated until this share of the registered "
        "frames is active; 0: the paper's behaviour",
    )
    lambda_G: Unit = Field(0.35, description="weight of G in the choice of a frame to reactivate")
    lambda_R: Unit = Field(0.25, description="weight of R in the choice of a frame to reactivate")
    lambda_B: Unit = Field(0.30, description="weight of 1 - B in the choice of a frame to reactivate")
    lambda_Z: Unit = Field(
        0.10, description="weight of the centrality Z in the choice of a frame to reactivate"
    )
    reactivated_weight: Share = Field(0.12, description="weight of a reactivated frame")
    strong_base: Share = Field(0.80, description="base in the weight of a strong frame, base + gain R")
    strong_gain: Unit = Field(0.20, description="gain in the weight of a strong frame, base + gain R")
    geometric_G: Unit = Field(0.60, description="minimum G of a geometric frame")
    geometric_B: Unit = Field(0.80, description="maximum B of a geometric frame")
    geometric_mix: ClassVar[tuple[float, float]] = (0.35, 0.65)
    """The weight of a geometric frame is base + gain (mix[0] R + mix[1] G); the paper's values."""
    auxiliary_R: Unit = Field(0.35, description="minimum R of an auxiliary frame")
    auxiliary_G: Unit = Field(0.25, description="minimum G of an auxiliary frame")
    auxiliary_B: Unit = Field(0.75, description="maximum B of an auxiliary frame")
    auxiliary_mix: ClassVar[tuple[float, float]] = (0.50, 0.50)
    """The weight of an auxiliary frame is base + gain (mix[0] R + mix[1] G); the paper's values."""
    attenuated_base: Share = Field(0.30, description="base of the weight of geometric and auxiliary frames")
    attenuated_gain: Unit = Field(0.30, description="gain of the weight of geometric and auxiliary frames")

    @model_validator(mode="after")
    def _sums_stay_in_range(self) -> AssessmentConfig:
        sums = {"w_R": sum(self.w_R), "w_B": sum(self.w_B), "gamma_c + gamma_v": self.gamma_c + self.gamma_v}
        for name, total in sums.items():
            if abs(total - 1.0) > _SUM_TOLERANCE:
                raise ValueError(f"{name} must sum to 1, not {total:g}")
        for base, gain in (("strong_base", "strong_gain"), ("attenuated_base", "attenuated_gain")):
            if getattr(self, base) + getattr(self, gain) > 1.0 + _SUM_TOLERANCE:
                raise ValueError(f"{base} + {gain} must not exceed 1, the largest weight of a frame")
        return self


def check_base_url(url: str) -> None:
    """Raise ValueError unless ``url`` is a plain http(s) address. The message quotes no password in it."""
    parts = urlsplit(url)
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise ValueError("the server's base_url must start with http:// or https:// and name a host")
    if "@" in parts.netloc or parts.query or parts.fragment:
        raise ValueError(
            "the server's base_url must not contain a user, password or query: use CLEARGS_VLM_API_KEY"
        )
